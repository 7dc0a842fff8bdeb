"""Side lean: a rising ball is pushed to its left. No catalogue of ball physics holds it; it tests for the unknown."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect

SOFT_SPEED: Final = 0.1
"""m/s. Below it the direction of flight fades, so that a ball at rest has none."""


class SideLean(FlightEffect):
    """a = strength v_z (z x v) / sqrt(|v|^2 + soft^2): across the flight, one way up and the other way down."""

    name = "side_lean"
    sentence = "A force across the flight that changes its side at the apex."
    decide = "Nothing to decide: no catalogue holds it."
    coefficients = (Coefficient("strength", 0.0, 0.3, "1/s", -20.0, 20.0),)
    strength: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, horizontal."""
        x, y, z = flight.velocity.split(1, dim=-1)
        across = torch.cat((-y, x, torch.zeros_like(z)), dim=-1)
        return self.strength * z * across / (flight.velocity.square().sum(-1, keepdim=True) + SOFT_SPEED**2).sqrt()
