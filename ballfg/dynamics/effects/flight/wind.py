"""Moving air: everywhere the same, growing with the height, or in one part of the room."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, vector
from ballfg.dynamics.scene import Scene
from ballfg.state import Z

PLACES: Final = (4, 2, 2)
"""Centres that are tried along x, y and z."""
REGION_SHARE: Final = 0.25
"""Size of a region that is tried, as a share of the longest extent of the data."""
LARGEST_REGION: Final = 50.0
"""m. Of a region that is tried."""


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


class GustRegion(FlightEffect):
    """Air velocity u exp(-|p - c|^2 / (2 size^2)) round a centre c, smooth so that integration stays accurate."""

    name = "gust_region"
    sentence = (
        "The air moves in one part of the room and is still elsewhere; a region much larger than the flights is a wind."
    )
    decide = "Shoot past the suspected place on both sides: the wind is everywhere, the gust in one place."
    coefficients = (
        *(Coefficient(axis, 0.0, 0.5, "m/s", -20.0, 20.0) for axis in "xyz"),
        Coefficient("center_x", 1.4, 1.0, "m", -100.0, 100.0, absent=None),
        Coefficient("center_y", 0.0, 0.5, "m", -100.0, 100.0, absent=None),
        Coefficient("center_z", 1.1, 0.5, "m", -100.0, 100.0, absent=None),
        Coefficient("size", 0.4, 0.2, "m", 0.01, 100.0, absent=None),
    )
    x: Tensor
    y: Tensor
    z: Tensor
    center_x: Tensor
    center_y: Tensor
    center_z: Tensor
    size: Tensor

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """Regions of one size at places over the extent of the data."""
        extent = [high - low for low, high in zip(scene.low, scene.high, strict=True)]
        axes = [
            [low + length * (i + 0.5) / count for i in range(count)]
            for low, length, count in zip(scene.low, extent, PLACES, strict=True)
        ]
        size = min(REGION_SHARE * max(extent), LARGEST_REGION)
        return [{"center_x": x, "center_y": y, "center_z": z, "size": size} for x, y, z in itertools.product(*axes)]

    def air_velocity(self, flight: Flight) -> Tensor:
        """(..., 3) m/s at the ball's place."""
        center = vector(self.center_x, self.center_y, self.center_z)
        distance = (flight.position - center).square().sum(-1, keepdim=True)
        share = torch.exp(-distance / (2 * self.size.square()))
        return share * vector(self.x, self.y, self.z)
