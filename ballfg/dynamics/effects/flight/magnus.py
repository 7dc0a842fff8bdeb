"""Magnus force: a spinning ball is pushed across its flight; the lift may saturate."""

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, length

TINY_SPEED: Final = 1e-9
"""m/s. Keeps 0/0 away for a ball that neither moves nor spins; the force is zero there anyway."""


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


class MagnusSaturation(FlightEffect):
    """k / (1 + strength S) in place of the declared Magnus k, with the spin ratio S = R |w| / |v|.

    Measured lift coefficients have this shape: Cl = 1 / (2 + |v| / (R |w|)) is S / (1 + 2 S), strength 2
    (A. Stepanek, "The aerodynamics of tennis balls - the topspin lob", American Journal of Physics 56, 1988).
    """

    name = "magnus_saturation"
    sentence = "Lift grows more slowly than the spin: it saturates with the spin ratio."
    decide = "Shoot at one speed with little, medium and much spin: the lift per spin must fall."
    coefficients = (Coefficient("strength", 0.0, 0.5, "1", 0.0, 20.0),)
    needs = ("magnus",)
    strength: Tensor

    def adjust(self, flight: Flight) -> Flight:
        """The flight with the lift multiplied by 1 / (1 + strength S)."""
        lost = self.strength * (flight.radius * length(flight.spin))
        return flight.more_lift(-lost / (flight.speed + lost).clamp_min(TINY_SPEED))
