"""Gravity and buoyancy: constant vertical accelerations."""

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect
from ballfg.state import STANDARD_GRAVITY

_DOWN = torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64)
_UP = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)


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
