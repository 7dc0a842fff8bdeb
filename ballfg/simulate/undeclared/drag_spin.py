"""Drag that grows with spin."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, length
from ballfg.simulate.undeclared.base import AirEffect


class DragSpin(AirEffect):
    """k (1 + gain S) in place of the declared drag's k, with the spin ratio S = R |w| / |v|."""

    name = "drag_spin"
    sentence = "The drag coefficient grows with the ratio of surface speed to flight speed."
    coefficients = (Coefficient("gain", 0.0, 0.3, "1", -1.0, 10.0),)
    gain: Tensor

    def _check(self) -> None:
        self._coefficient("drag", "k")

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2 on top of the declared drag; S |v| = R |w| has no pole at rest."""
        surface_speed = self._radius * length(flight.spin)
        return -(self._coefficient("drag", "k") * self.gain * surface_speed) * flight.velocity
