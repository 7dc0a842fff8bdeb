"""Wind: the air in the whole room moves."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, vector
from ballfg.simulate.undeclared.base import AirEffect


class Wind(AirEffect):
    """Air forces at v - u in place of v, with a constant air velocity u.

    For drag alone that adds k |v| v - k |v - u| (v - u); the Magnus force follows the air in the same way.
    """

    name = "wind"
    sentence = "The air moves at a constant velocity: drag and Magnus force act on the velocity against the air."
    coefficients = tuple(Coefficient(axis, 0.0, 0.3, "m/s", -20.0, 20.0) for axis in "xyz")
    x: Tensor
    y: Tensor
    z: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2 by which the moving air changes the declared forces."""
        return self._moving_air(flight, vector(self.x, self.y, self.z))
