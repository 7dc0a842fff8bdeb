"""Wind: the air in the whole room moves."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, vector


class Wind(FlightEffect):
    """All air forces act on v - u, with a constant air velocity u; drag alone becomes -k |v - u| (v - u)."""

    name = "wind"
    sentence = "The air moves at a constant velocity: drag and Magnus force act on the velocity against the air."
    decide = "Shoot in the opposite direction, or across: the wind keeps its direction, drag turns with the shot."
    coefficients = tuple(Coefficient(axis, 0.0, 0.3, "m/s", -20.0, 20.0) for axis in "xyz")
    x: Tensor
    y: Tensor
    z: Tensor

    def air_velocity(self, flight: Flight) -> Tensor:
        """(3,) or (..., 3) m/s, the same everywhere."""
        return vector(self.x, self.y, self.z)
