"""Draws balls and flights from the population that the intervals of one camera's strokes are for.

Coefficients have the spreads that the model declares, spins those of strokes; flights and bounces scatter with the
process noise of such a track. A nominal ball, which nothing scatters, would be inside of all intervals.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel
from ballfg.estimation.settings import Settings
from ballfg.state import SPIN, VELOCITY, VZ, Z
from ballfg.vision.broadcast.court import NET_HEIGHT
from tests.estimation.observations.sighted_rig import TABLE
from tests.estimation.rallies import MODEL, Stroke, flown, stroke

SETTINGS: Final = Settings.for_measured(MODEL)
STEP: Final = 0.004  # s
MOST_ODD: Final = 2.5  # standard deviations of a ball's coefficients
TRIES: Final = 40


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
            value += sigma * float(np.clip(rng.standard_normal(), -MOST_ODD, MOST_ODD))
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
