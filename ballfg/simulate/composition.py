"""The true ball: the declared model, what nobody declares, and kicks at contacts."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import cast

import numpy as np
import torch
from torch import Tensor

from ballfg.dynamics import AnalyticModel, BallModel, Effect, FlightEffect
from ballfg.dynamics.model import Rates
from ballfg.dynamics.rollout import REST_SPEED
from ballfg.simulate.config import ProcessNoise
from ballfg.simulate.undeclared import AirEffect, MeasurementEffect
from ballfg.state import SPIN, STATE_DIM, VELOCITY, VZ


def true_model(declared: AnalyticModel, undeclared: Iterable[Effect]) -> AnalyticModel:
    """The declared model with undeclared effects of flight and bounce in it; the arguments stay as they are.

    An undeclared effect that the model declares too takes the place of the declared one: the truth then has another
    value than the model.

    Raises: ValueError: if an effect is given twice, or changes one that the model does not have.
    """
    listed = [cast(Effect, effect) for effect in (*declared.flight.values(), *declared.contact.values())]
    effects = {effect.name: effect for effect in listed}
    seen: set[str] = set()
    for effect in undeclared:
        if effect.name in seen:
            raise ValueError(f"undeclared effects must differ; '{effect.name}' was given twice. Remove one.")
        seen.add(effect.name)
        if not isinstance(effect, MeasurementEffect):
            effects[effect.name] = copy.deepcopy(effect)  # attaching must not change the caller's
    changed = [effect for effect in effects.values() if isinstance(effect, AirEffect)]
    basis = [effect for effect in effects.values() if isinstance(effect, FlightEffect) and effect not in changed]
    for air_effect in changed:
        air_effect.attach(basis, declared.radius)
    return AnalyticModel(effects.values(), radius=declared.radius, inertia_factor=declared.inertia_factor)


class KickedModel(BallModel):
    """A model whose contacts are disturbed: each bounce adds a random kick to velocity and spin.

    The upward speed after a bounce is reflected at zero if a kick would push the ball into the surface.
    """

    def __init__(self, model: BallModel, noise: ProcessNoise, rng: np.random.Generator) -> None:
        super().__init__(model.radius, model.inertia_factor)
        self.model = model
        self._rng = rng
        sigma = torch.zeros(STATE_DIM, dtype=torch.float64)
        sigma[VELOCITY], sigma[SPIN] = noise.contact_velocity, noise.contact_spin
        self._sigma = sigma

    def rates(self, state: Tensor) -> Rates:
        """Those of the undisturbed model."""
        return self.model.rates(state)

    def surface_offset(self, state: Tensor) -> Tensor | float:
        """That of the undisturbed model."""
        return self.model.surface_offset(state)

    def bounce(self, state: Tensor) -> Tensor:
        """(..., 9) after the impact and its kick. A bounce that ends in rest gets none: it would start again."""
        after = self.model.bounce(state)
        kicked = after + self._sigma * torch.from_numpy(self._rng.standard_normal(tuple(after.shape)))
        kicked[..., VZ] = kicked[..., VZ].abs()
        rests = after[..., VZ : VZ + 1] < REST_SPEED
        return torch.where(rests, after, kicked)
