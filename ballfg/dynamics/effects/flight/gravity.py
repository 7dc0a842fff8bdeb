"""Gravity: a constant acceleration downwards."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect
from ballfg.state import STANDARD_GRAVITY

_DOWN = torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64)


class Gravity(FlightEffect):
    """a = (0, 0, -g). Buoyancy of the air is the same as a smaller g."""

    name = "gravity"
    sentence = (
        "The weight of the ball: a constant downward acceleration; the same as buoyancy and, once drag and Magnus "
        "force are free, as another time scale."
    )
    decide = "Look up the local g, known to four digits: a ball that falls otherwise shows a wrong clock or length."
    coefficients = (Coefficient("g", STANDARD_GRAVITY, 0.0, "m/s^2", 0.0, 30.0),)
    g: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, straight down."""
        return self.g * _DOWN
