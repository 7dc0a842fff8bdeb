"""Magnus force that saturates at high spin."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, length
from ballfg.simulate.undeclared.base import AirEffect

TINY_SPEED: Final = 1e-9
"""m/s. Keeps 0/0 away for a ball that neither moves nor spins; the force is zero there anyway."""


class MagnusSaturation(AirEffect):
    """k / (1 + strength S) in place of the declared Magnus k, with the spin ratio S = R |w| / |v|.

    Measured lift coefficients have this shape: Cl = 1 / (2 + |v| / (R |w|)) is S / (1 + 2 S), strength 2
    (A. Stepanek, "The aerodynamics of tennis balls - the topspin lob", American Journal of Physics 56, 1988).
    """

    name = "magnus_saturation"
    sentence = "Lift grows more slowly than the spin: it saturates with the spin ratio."
    coefficients = (Coefficient("strength", 0.0, 0.5, "1", 0.0, 20.0),)
    strength: Tensor

    def _check(self) -> None:
        self._coefficient("magnus", "k")

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2 on top of the declared Magnus force: k (spin x v) (1 / (1 + strength S) - 1)."""
        surface_speed = self._radius * length(flight.spin)
        lost = self.strength * surface_speed
        share = lost / (flight.speed + lost).clamp_min(TINY_SPEED)
        return -(self._coefficient("magnus", "k") * share) * torch.linalg.cross(flight.spin, flight.velocity)
