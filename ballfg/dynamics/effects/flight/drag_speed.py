"""Drag whose coefficient depends on the speed, as near the drag crisis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect
from ballfg.dynamics.scene import Scene


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
