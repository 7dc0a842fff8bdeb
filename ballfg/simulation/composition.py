"""Composes the true ball from the declared model, undeclared effects, and kicks at contacts."""

from collections.abc import Iterable
from typing import cast

import numpy as np
import torch
from torch import Tensor

from ballfg.checks import check_each
from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.model import Rates
from ballfg.dynamics.motion.limits import REST_SPEED
from ballfg.simulation.config import MotionNoise
from ballfg.state import SPIN, STATE_DIM, VELOCITY, VZ


def true_model(declared: AnalyticModel, undeclared: Iterable[Effect]) -> AnalyticModel:
    """The declared model with undeclared effects in it; the arguments are not changed.

    An undeclared effect replaces a declared one of the same name: the truth then has another value than the model.

    Raises: ValueError: if an effect is given twice, or changes one that the model does not have.
    """
    groups = (declared.flight, declared.bounce, declared.measurement)
    effects = {name: cast(Effect, effect) for group in groups for name, effect in group.items()}
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
