"""The analytic model: a ball whose motion is a sum of named physical effects."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor, nn

from ballfg.dynamics.effect import BounceEffect, Coefficient, Effect, Flight, FlightEffect, Impact
from ballfg.dynamics.impact import apply_impulse
from ballfg.dynamics.model import THIN_SHELL, BallModel, Rates
from ballfg.state import POSITION, SPIN, VELOCITY

_ONE, _ZERO = torch.tensor(1.0, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64)


class AnalyticModel(BallModel):
    """Free flight as the sum of flight effects; a bounce as an impulse whose coefficients bounce effects set.

    Without a restitution effect a bounce loses no normal speed; without friction the surface is slippery.
    Effects act on an impact in the order in which they are given.

    Attributes:
        flight: `nn.ModuleDict` of flight effects by name.  contact: `nn.ModuleDict` of bounce effects by name.
    """

    def __init__(self, effects: Iterable[Effect], *, radius: float = 0.02, inertia_factor: float = THIN_SHELL) -> None:
        super().__init__(radius, inertia_factor)
        self.flight = nn.ModuleDict()
        self.contact = nn.ModuleDict()
        for effect in effects:
            group = self.flight if isinstance(effect, FlightEffect) else self.contact
            if effect.name in group:
                raise ValueError(f"effects must differ; '{effect.name}' was given twice. Remove one.")
            group[effect.name] = effect

    def declared_coefficients(self) -> dict[str, Coefficient]:
        """The coefficients of all effects, for instance under `flight.drag.k`."""
        return {
            f"{section}.{name}.{c.name}": c
            for section, group in (("flight", self.flight), ("contact", self.contact))
            for name, effect in group.items()
            for c in cast(Effect, effect).coefficients
        }

    def rates(self, state: Tensor) -> Rates:
        """Acceleration and angular acceleration in free flight."""
        flight = Flight(state)
        acceleration: Tensor | None = None
        spin_rate: Tensor | None = None
        for module in self.flight.values():
            effect = cast(FlightEffect, module)
            a, w = effect.acceleration(flight), effect.spin_rate(flight)
            if a is not None:
                acceleration = a if acceleration is None else acceleration + a
            if w is not None:
                spin_rate = w if spin_rate is None else spin_rate + w
        if acceleration is None:
            return torch.zeros_like(flight.velocity), spin_rate
        if acceleration.shape != flight.velocity.shape:  # gravity alone is one vector for all
            acceleration = acceleration.expand_as(flight.velocity)
        return acceleration, spin_rate

    def bounce(self, state: Tensor) -> Tensor:
        """(..., 9) state just after an impact on a horizontal plane; the position does not change."""
        impact = Impact(state[..., VELOCITY], state[..., SPIN], _ONE, _ZERO, _ZERO)
        for module in self.contact.values():
            impact = cast(BounceEffect, module).adjust(impact)
        velocity, spin = apply_impulse(impact, self.radius, self.inertia_factor)
        return torch.cat((state[..., POSITION], velocity, spin), dim=-1)

    def surface_offset(self, state: Tensor) -> Tensor | float:
        """(...) m by which surfaces lie above the heights declared for them."""
        total: Tensor | None = None
        for module in self.contact.values():
            offset = cast(BounceEffect, module).surface_offset()
            if offset is not None:
                total = offset if total is None else total + offset
        if total is None:
            return 0.0
        return total.squeeze(-1) if total.dim() else total

    def extra_repr(self) -> str:
        """Radius and inertia factor for `print(model)`."""
        return f"radius={self.radius:g} m, inertia_factor={self.inertia_factor:g}"


def coefficient_sigmas(model: BallModel) -> dict[str, float]:
    """Prior standard deviations of the coefficients that are estimated with each track, by parameter name.

    Args: model: one that declares nothing of its parameters gives an empty mapping.
    Returns: for instance {"flight.drag.k": 0.035}; coefficients that do not vary are left out.
    """
    return {name: c.sigma for name, c in model.declared_coefficients().items() if c.varies}
