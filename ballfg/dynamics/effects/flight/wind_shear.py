"""Wind shear: the air moves faster the higher it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, vector
from ballfg.dynamics.scene import Scene
from ballfg.state import Z


class WindShear(FlightEffect):
    """Air velocity (x, y, 0) (p_z - reference): a horizontal wind that grows linearly with height."""

    name = "wind_shear"
    sentence = (
        "The air moves horizontally, in proportion to the height above a reference; another reference is the same as a "
        "wind on top."
    )
    decide = "Shoot at different heights in one direction, or hold a thread at two heights."
    coefficients = (
        *(Coefficient(axis, 0.0, 0.3, "1/s", -20.0, 20.0) for axis in "xy"),
        Coefficient("reference", 1.0, 0.5, "m", -100.0, 100.0, absent=None),
    )
    x: Tensor
    y: Tensor
    reference: Tensor

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """The reference in the middle of the data."""
        return ({"reference": scene.middle[2]},)

    def air_velocity(self, flight: Flight) -> Tensor:
        """(..., 3) m/s at the height of the ball."""
        above = flight.position[..., Z : Z + 1] - self.reference
        return above * vector(self.x, self.y, torch.zeros_like(self.x))
