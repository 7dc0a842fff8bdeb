"""Composes the true ball and simulates its motion frame by frame, through contacts, with noise."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ballfg.checks import check_each
from ballfg.dynamics import AnalyticModel, BallModel, Surfaces, rollout
from ballfg.dynamics.compiled.flight import white_acceleration
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.model import Rates
from ballfg.dynamics.motion.limits import REST_SPEED
from ballfg.dynamics.motion.rollout import advance, is_resting
from ballfg.simulation.config import MotionNoise
from ballfg.simulation.launcher import SimulatedLauncher
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY, VZ, Z

NOISE_STEP = 0.005
"""s. Largest step of process noise. In free flight its discretisation is exact for any step; in a step with a contact
the noise is added after the bounce, so that the step must be short."""
TOGETHER = 32  # Number of frames computed at once; a ball that has left the view is followed for as many more at most
MIN_FRAMES = 5  # Least number of frames of a track, even if the ball leaves the view at once


def true_model(declared: AnalyticModel, undeclared: Iterable[Effect]) -> AnalyticModel:
    """The declared model with undeclared effects in it; the arguments are not changed.

    An undeclared effect replaces a declared one of the same name: the truth then has another value than the model.

    Raises: ValueError: if an effect is given twice, or changes one that the model does not have.
    """
    effects = {effect.name: effect for effect in declared.effects}
    seen: set[str] = set()
    for effect in check_each("undeclared", undeclared, Effect, "Give Wind() or another one."):
        if effect.name in seen:
            raise ValueError(f"undeclared effects must differ; '{effect.name}' was given twice. Remove one.")
        seen.add(effect.name)
        effects[effect.name] = effect
    return AnalyticModel(effects.values(), radius=declared.radius, inertia_factor=declared.inertia_factor)


class KickedModel(BallModel):
    """A model with random kicks to velocity and spin at each bounce.

    The upward speed after a bounce is reflected at zero if a kick would push the ball into the surface.
    """

    random = True

    def __init__(self, model: BallModel, noise: MotionNoise, rng: np.random.Generator) -> None:
        super().__init__(model.radius, model.inertia_factor)
        self.model = model
        self._rng = rng
        sigma = torch.zeros(STATE_DIM, dtype=torch.float64)
        sigma[VELOCITY], sigma[SPIN] = noise.contact_velocity, noise.contact_spin
        self._sigma = sigma

    @property
    def in_flight(self) -> BallModel:
        """The undisturbed model."""
        return self.model

    def rates(self, state: Tensor) -> Rates:
        """The rates of the undisturbed model."""
        return self.model.rates(state)

    def surface_offset(self, state: Tensor) -> Tensor | float:
        """The surface offset of the undisturbed model."""
        return self.model.surface_offset(state)

    def surface_slope(self, state: Tensor) -> Tensor | None:
        """The surface slope of the undisturbed model."""
        return self.model.surface_slope(state)

    def after_bounce(self, state: Tensor) -> Tensor:
        """(..., 9) after the impact and its kick. A bounce that ends in rest gets none: it would start again."""
        after = self.model.after_bounce(state)
        kicked = after + self._sigma * torch.from_numpy(self._rng.standard_normal(tuple(after.shape)))
        kicked[..., VZ] = kicked[..., VZ].abs()
        rests = after[..., VZ : VZ + 1] < REST_SPEED
        return torch.where(rests, after, kicked)


@dataclass(frozen=True)
class TrueMotion:
    """The true states of a block of shots at their frames, frame k at k / rate seconds."""

    states: NDArray[np.float64]  # (n, k, 9); undefined after the end of a track
    lengths: NDArray[np.int64]  # (n,) frames of each track


@torch.no_grad()
def simulate_motion(
    model: BallModel,
    start: Tensor,
    rate: float,
    surfaces: Surfaces,
    launcher: SimulatedLauncher,
    noise: MotionNoise,
    rng: np.random.Generator,
) -> TrueMotion:
    """Follows shots until they leave the launcher's view or last too long.

    Args:
        start: (n, 9) first states.  rate: Hz.  launcher: determines the end of a track.
        noise: process noise of the flight; that of contacts is in `model`.  rng: draws the process noise.
    Returns: the frames; the first is `start`.
    """
    frames = max(MIN_FRAMES, math.floor(launcher.duration * rate + 1e-9) + 1)
    states = torch.zeros((len(start), frames, STATE_DIM), dtype=torch.float64)
    states[:, 0] = start
    lengths = torch.ones(len(start), dtype=torch.int64)
    alive = torch.arange(len(start))
    state = start
    # a random draw depends on which balls are still followed, so that those go frame by frame
    together = 1 if noise.in_flight or model.random else TOGETHER
    for k in range(1, frames, together):
        count = min(together, frames - k)
        ahead = _next_frames(model, state, count, 1.0 / rate, surfaces, noise, rng)
        seen = launcher.in_view(ahead, surfaces, model) | (torch.arange(k, k + count) < MIN_FRAMES)
        kept = seen.cumprod(dim=1).sum(dim=1)
        states[alive, k : k + count] = ahead
        lengths[alive] += kept
        alive, state = alive[kept == count], ahead[kept == count, -1]
        if len(alive) == 0:
            break
    return TrueMotion(states.numpy(), lengths.numpy())


def _next_frames(
    model: BallModel,
    state: Tensor,
    count: int,
    dt: float,
    surfaces: Surfaces,
    noise: MotionNoise,
    rng: np.random.Generator,
) -> Tensor:
    """(n, count, 9) the frames after a state (n, 9), which are `dt` s apart; one frame where noise disturbs them."""
    if not noise.in_flight:
        return rollout(model, state, dt * torch.arange(1, count + 1, dtype=torch.float64), surfaces)
    steps = math.ceil(dt / NOISE_STEP - 1e-9)
    h = torch.full((len(state),), dt / steps, dtype=torch.float64)
    for _ in range(steps):
        state = advance(model, state, h, surfaces)
        disturbance = process_noise(len(state), dt / steps, noise, rng)
        resting = is_resting(model, state, surfaces.height_below(state, model.surface_offset(state)))
        disturbance[resting, Z] = 0.0  # the surface absorbs it
        disturbance[resting, VZ] = 0.0
        state = state + disturbance
    return state[:, None]


def process_noise(count: int, dt: float, noise: MotionNoise, rng: np.random.Generator) -> Tensor:
    """(count, 9) what white acceleration adds to states over dt (s), drawn exactly; the spin is a random walk."""
    a, b, c = rng.standard_normal((3, count, 3))
    position, between, velocity = white_acceleration(dt, 1.0)
    root = np.linalg.cholesky([[velocity, between], [between, position]])
    added = np.zeros((count, STATE_DIM))
    added[:, VELOCITY] = noise.acceleration * root[0, 0] * a
    added[:, POSITION] = noise.acceleration * (root[1, 0] * a + root[1, 1] * b)
    added[:, SPIN] = noise.spin * math.sqrt(dt) * c
    return torch.from_numpy(added)
