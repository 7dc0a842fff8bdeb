"""Drag: the air slows the ball, in proportion to the square of its speed; the factor may depend on speed and spin."""

from collections.abc import Mapping, Sequence

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect
from ballfg.dynamics.scene import Scene


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


class DragSpeed(FlightEffect):
    """k (1 + slope (|v| - reference)) in place of the declared drag's k."""

    name = "drag_speed"
    sentence = (
        "The drag coefficient changes with speed (with the Reynolds number); another reference is the same as another "
        "drag and slope."
    )
    decide = "Shoot without spin at very different speeds, in both directions so that a wind cancels."
    coefficients = (
        Coefficient("slope", 0.0, 0.02, "s/m", -0.2, 0.2),
        Coefficient("reference", 5.0, 0.0, "m/s", 0.0, 20.0, absent=None),
    )
    needs = ("drag",)
    slope: Tensor
    reference: Tensor

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """The reference in the middle of the data."""
        return ({"reference": scene.speed},)

    def adjust(self, flight: Flight) -> Flight:
        """The flight with more drag where it is fast."""
        return flight.more_drag(self.slope * (flight.speed - self.reference))


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
