"""Buoyancy: the air that the ball displaces carries a part of its weight."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect

_UP = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)


class Buoyancy(FlightEffect):
    """An acceleration (0, 0, a): rho V g / m, 0.146 m/s^2 for a ball of 40 mm and 2.7 g in air of 1.2 kg/m^3."""

    name = "buoyancy"
    sentence = "The displaced air carries a part of the weight: exactly the same as a smaller g."
    decide = "Weigh the ball and measure its diameter: rho V g / m is known; tracks show only the sum with gravity."
    coefficients = (Coefficient("a", 0.0, 0.15, "m/s^2", -5.0, 5.0),)
    a: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, straight up."""
        return self.a * _UP
