"""Frame tilt: the measured z axis is not plumb."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import TINY_LENGTH, Coefficient, length, vector
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION


class FrameTilt(MeasurementEffect):
    """Positions turned about the origin by the rotation vector (x, y, 0); labels stay in the true frame."""

    name = "frame_tilt"
    sentence = (
        "The frame of the measurements is tilted against the vertical: the same as a gravity that leans the other way "
        "and a table that tilts."
    )
    decide = "Film a plumb line, or a ball rolling on a levelled table."
    coefficients = tuple(Coefficient(axis, 0.0, 0.01, "rad", -0.5, 0.5) for axis in "xy")
    rank = 10
    x: Tensor
    y: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, in the tilted frame: Rodrigues' formula, p + sin(a)/a r x p + (1 - cos(a))/a^2 r x (r x p)."""
        position = states[..., POSITION]
        axis = vector(self.x, self.y, torch.zeros_like(self.x))
        angle = length(axis).clamp_min(TINY_LENGTH)
        once = torch.linalg.cross(axis.expand_as(position), position)
        twice = torch.linalg.cross(axis.expand_as(position), once)
        half = torch.sin(angle / 2) / angle
        return position + torch.sin(angle) / angle * once + 2 * half.square() * twice
