"""Drag that grows with spin."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect


class DragSpin(FlightEffect):
    """k (1 + gain S) in place of the declared drag's k, with the spin ratio S = R |w| / |v|."""

    name = "drag_spin"
    sentence = "The drag coefficient grows with the ratio of surface speed to flight speed."
    decide = "Shoot at one speed with and without spin; sidespin and topspin must slow the ball alike."
    coefficients = (Coefficient("gain", 0.0, 0.3, "1", -10.0, 10.0),)
    needs = ("drag",)
    gain: Tensor

    def adjust(self, flight: Flight) -> Flight:
        """The flight with more drag where it spins; the force, with S |v| = R |w|, has no pole at rest."""
        return flight.more_drag(self.gain * flight.spin_ratio)
