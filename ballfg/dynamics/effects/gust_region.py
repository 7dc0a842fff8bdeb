"""Gust region: the air moves in one part of the room only, as before a fan."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, vector


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

    def air_velocity(self, flight: Flight) -> Tensor:
        """(..., 3) m/s at the ball's place."""
        center = vector(self.center_x, self.center_y, self.center_z)
        distance = (flight.position - center).square().sum(-1, keepdim=True)
        share = torch.exp(-distance / (2 * self.size.square()))
        return share * vector(self.x, self.y, self.z)
