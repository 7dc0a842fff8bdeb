"""Gust region: the air moves in one part of the room only, as before a fan."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, vector
from ballfg.simulate.undeclared.base import AirEffect


class GustRegion(AirEffect):
    """Air velocity u exp(-|p - c|^2 / (2 size^2)) round a centre c, smooth so that integration stays accurate."""

    name = "gust_region"
    sentence = "The air moves in one part of the room and is still elsewhere."
    coefficients = (
        *(Coefficient(axis, 0.0, 0.5, "m/s", -20.0, 20.0) for axis in "xyz"),
        Coefficient("center_x", 1.4, 1.0, "m", -100.0, 100.0),
        Coefficient("center_y", 0.0, 0.5, "m", -100.0, 100.0),
        Coefficient("center_z", 1.1, 0.5, "m", -100.0, 100.0),
        Coefficient("size", 0.4, 0.2, "m", 0.01, 100.0),
    )
    x: Tensor
    y: Tensor
    z: Tensor
    center_x: Tensor
    center_y: Tensor
    center_z: Tensor
    size: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2 by which the moving air changes the declared forces."""
        center = vector(self.center_x, self.center_y, self.center_z)
        distance = (flight.position - center).square().sum(-1, keepdim=True)
        share = torch.exp(-distance / (2 * self.size.square()))
        return self._moving_air(flight, share * vector(self.x, self.y, self.z))
