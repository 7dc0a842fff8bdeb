"""Drag: the air slows the ball, in proportion to the square of its speed."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect


class Drag(FlightEffect):
    """a = -k |v| v, with k = rho Cd A / (2 m): 0.14 1/m for Cd = 0.49; fits of real tracks give 0.08 to 0.16."""

    name = "drag"
    sentence = "Quadratic air drag with a constant coefficient."
    decide = "Vary the speed of still-air shots: drag grows with its square and points backwards, whatever the spin."
    coefficients = (Coefficient("k", 0.12, 0.035, "1/m", 0.0, 2.0, varies=True),)
    k: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, opposite to the velocity; zero, with zero derivative, at rest."""
        k = self.k if flight.drag_gain is None else self.k * flight.drag_gain
        return -(k * flight.speed) * flight.velocity
