"""Magnus force: a spinning ball is pushed across its flight."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect


class Magnus(FlightEffect):
    """a = k (spin x v), k dimensionless: sources differ by 3.6 times (0.0010 to 0.0036)."""

    name = "magnus"
    multiplies_spin = True
    sentence = "Lift of a spinning ball, proportional to spin x velocity."
    decide = (
        "Shoot with spins of opposite sign at one speed: the lift changes its sign with the spin, nothing else does."
    )
    coefficients = (Coefficient("k", 0.0028, 0.0008, "1", -0.1, 0.1),)
    k: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, perpendicular to velocity and spin."""
        k = self.k if flight.lift_gain is None else self.k * flight.lift_gain
        return k * torch.linalg.cross(flight.spin, flight.velocity)
