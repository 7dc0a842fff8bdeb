"""Drag whose coefficient depends on the speed, as near the drag crisis."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight
from ballfg.simulate.undeclared.base import AirEffect


class DragSpeed(AirEffect):
    """k (1 + slope (|v| - reference)) in place of the declared drag's k."""

    name = "drag_speed"
    sentence = "The drag coefficient changes with speed (with the Reynolds number)."
    coefficients = (
        Coefficient("slope", 0.0, 0.02, "s/m", -0.05, 0.2),
        Coefficient("reference", 5.0, 2.0, "m/s", 0.0, 20.0),
    )
    slope: Tensor
    reference: Tensor

    def _check(self) -> None:
        self._coefficient("drag", "k")

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2 on top of the declared drag."""
        k = self._coefficient("drag", "k")
        return -(k * self.slope * (flight.speed - self.reference) * flight.speed) * flight.velocity
