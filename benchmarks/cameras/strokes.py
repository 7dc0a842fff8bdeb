"""Draws balls and strokes from the population that the intervals of one camera's strokes are for.

Coefficients have the spreads that the model declares, spins those of strokes; flights and bounces scatter with the
process noise of such a track. A nominal ball, which nothing scatters, would be inside of all intervals.
"""

import copy
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel, Surfaces, nominal_model
from ballfg.dynamics.motion.rollout import rollout
from ballfg.estimation.settings import Settings
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, VELOCITY, VZ, Z
from ballfg.vision.broadcast.court import NET_HEIGHT

TABLE: Final = 0.76
"""m, height of the table's surface."""
MODEL: Final = nominal_model()
SURFACES: Final = replace(Surfaces.table_tennis(TABLE), extent=(-1.37, 1.37, -0.7625, 0.7625))
SETTINGS: Final = Settings.for_measured(MODEL)
STEP: Final = 0.004  # s
MOST_ODD: Final = 2.5  # standard deviations of a ball's coefficients
TRIES: Final = 40


@dataclass(frozen=True)
class Stroke:
    """A stroke from `begin` to `end`, s in its rally, and its first state (9,)."""

    begin: float
    end: float
    state: Array


def flown(state: Array, times: Array, ball: AnalyticModel = MODEL) -> Array:
    """(n, 9) states at times (n,) s after a first one (9,)."""
    with torch.no_grad():
        given = torch.from_numpy(state[None]), torch.from_numpy(np.append(0.0, times))
        return np.asarray(rollout(ball, *given, SURFACES)[0, 1:])


def stroke(
    place: Array, to: float, rng: np.random.Generator, ball: AnalyticModel = MODEL, given: Array | None = None
) -> tuple[Array, float] | None:
    """First state and duration of a stroke from a place to a half of the table, to: 1 or -1; None if none was drawn.

    Args: given: its spin (3,) rad/s; None: drawn.
    """
    for _ in range(60):
        aim = np.array([to * rng.uniform(0.35, 1.15), rng.uniform(-0.5, 0.5), TABLE + 0.02])
        time = rng.uniform(0.28, 0.45)
        spin = np.array([rng.normal(0, 15), to * rng.normal(60, 60), rng.normal(0, 15)])
        spin = spin if given is None else given
        velocity = (aim - place) / time
        velocity[2] += 0.5 * STANDARD_GRAVITY * time
        for _ in range(4):
            end = flown(np.concatenate((place, velocity, spin)), np.array([0.999 * time]), ball)[0]
            velocity = velocity + (np.array([0.0, 0.0, 0.3]) if end[VZ] > 0.0 else (aim - end[POSITION]) / time)
        state, lasts = np.concatenate((place, velocity, spin)), time + rng.uniform(0.15, 0.32)
        moments = np.arange(0.004, lasts, 0.004)
        path = flown(state, moments, ball)
        (turns,) = np.nonzero(np.diff(path[:, VZ]) > 1.0)
        above = path[-1, Z] - TABLE
        fine = len(turns) == 1 and abs(moments[turns[0]] - time) < 0.08 and 0.03 < above < 0.6
        if fine and abs(path[-1, 0]) < 2.4 and np.linalg.norm(velocity) < 13.0:
            return state, lasts
    return None


@dataclass(frozen=True)
class Scattered(Stroke):
    """A stroke whose flight scatters: states (k, 9) each `STEP` from its begin on, each with what came after it."""

    path: Array
    ball: AnalyticModel

    def at(self, t: float) -> Array:
        """(9,) at t s of the rally."""
        number = min(int((t - self.begin) / STEP), len(self.path) - 1)
        since = max(t - self.begin - number * STEP, 1e-9)
        return flown(self.path[number], np.array([since]), self.ball)[0]


def drawn_ball(rng: np.random.Generator) -> AnalyticModel:
    """A ball of the population."""
    ball = copy.deepcopy(MODEL)
    with torch.no_grad():
        for name, sigma in SETTINGS.coefficients.items():
            value = ball.get_parameter(name)
            value.add_(sigma * float(np.clip(rng.standard_normal(), -MOST_ODD, MOST_ODD)))
    return ball


def scattered(begin: float, place: Array, to: float, ball: AnalyticModel, rng: np.random.Generator) -> Scattered | None:
    """A stroke of the population from a place to a half of the table, to: 1 or -1; None if none was drawn."""
    noise = SETTINGS.process
    acceleration = max(noise.acceleration, SETTINGS.one_view_acceleration)
    slip = np.array([noise.contact_tangential, noise.contact_tangential, 0.0])
    for _ in range(TRIES):
        spin = rng.normal(0.0, SETTINGS.one_view_spin)
        spin[1] *= to
        drawn = stroke(place, to, rng, ball, spin)
        if drawn is None:
            continue
        path = [drawn[0]]
        bounces = 0
        for _ in range(int(np.ceil(drawn[1] / STEP))):
            state = flown(path[-1], np.array([STEP]), ball)[0]
            if state[VZ] - path[-1][VZ] > 1.0:
                bounces += 1
                state[VELOCITY] += np.hypot(slip, noise.contact_velocity) * rng.standard_normal(3)
                state[SPIN] += noise.contact_spin * rng.standard_normal(3)
            state[VELOCITY] += acceleration * np.sqrt(STEP) * rng.standard_normal(3)
            state[SPIN] += noise.spin * np.sqrt(STEP) * rng.standard_normal(3)
            path.append(state)
        states = np.array(path)
        over = np.interp(0.0, to * states[:, 0], states[:, Z]) - TABLE
        if bounces == 1 and over > NET_HEIGHT + MODEL.radius:
            return Scattered(begin, begin + drawn[1], drawn[0], states, ball)
    return None
