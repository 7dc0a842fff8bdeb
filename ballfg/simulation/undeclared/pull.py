"""Pull: a force toward one place in the room. No catalogue of ball physics holds it; it tests for the unknown."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, vector


class Pull(FlightEffect):
    """a = strength d / sqrt(|d|^2 + soft^2), with d from the ball to the place: of constant size away from it."""

    name = "pull"
    sentence = "A force toward one place in the room."
    decide = "Nothing to decide: no catalogue holds it."
    coefficients = (
        Coefficient("strength", 0.0, 0.3, "m/s^2", -20.0, 20.0),
        Coefficient("x", 1.4, 1.0, "m", -100.0, 100.0, absent=None),
        Coefficient("y", 0.5, 0.5, "m", -100.0, 100.0, absent=None),
        Coefficient("z", 1.5, 0.5, "m", -100.0, 100.0, absent=None),
        Coefficient("soft", 0.3, 0.1, "m", 0.01, 100.0, absent=None),
    )
    strength: Tensor
    x: Tensor
    y: Tensor
    z: Tensor
    soft: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2 toward the place; zero in it."""
        way = vector(self.x, self.y, self.z) - flight.position
        return self.strength * way / (way.square().sum(-1, keepdim=True) + self.soft.square()).sqrt()
