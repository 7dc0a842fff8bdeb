"""Errors of the frame: tilted axes, wrong lengths, a wrong range from one place."""

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import TINY_LENGTH, Coefficient, length, vector
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION

SOFT_DISTANCE: Final = 0.05
"""m. Nearer to the centre than this the bias falls to zero, so that it has a direction nowhere and a derivative
everywhere; 2 m away it is 0.03 % smaller than its coefficient."""


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


class Scale(MeasurementEffect):
    """Each coordinate times 1 + its error, about the origin of the frame."""

    name = "scale"
    sentence = (
        "Measured lengths are too long or too short by a factor along each axis; the same factor on all is another g, "
        "drag, radius and table height."
    )
    decide = "Measure a rod of known length along each axis."
    coefficients = tuple(Coefficient(axis, 0.0, 0.01, "1", -0.5, 0.5) for axis in "xyz")
    rank = 11
    x: Tensor
    y: Tensor
    z: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, stretched."""
        return states[..., POSITION] * (1.0 + vector(self.x, self.y, self.z))


class RadialBias(MeasurementEffect):
    """Positions moved away from a centre c, such as a camera: p + offset d / sqrt(|d|^2 + soft^2) with d = p - c."""

    name = "radial_bias"
    sentence = "Positions lie a constant distance too far from one place, as with a wrong range of a camera."
    decide = "Measure a ball at rest in several known places: the error points away from the centre."
    coefficients = (
        Coefficient("offset", 0.0, 0.005, "m", -0.5, 0.5),
        Coefficient("x", 0.0, 1.0, "m", -100.0, 100.0, absent=None),
        Coefficient("y", 0.0, 1.0, "m", -100.0, 100.0, absent=None),
        Coefficient("z", 0.0, 1.0, "m", -100.0, 100.0, absent=None),
    )
    rank = 12
    offset: Tensor
    x: Tensor
    y: Tensor
    z: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, pushed outwards."""
        position = states[..., POSITION]
        away = position - vector(self.x, self.y, self.z)
        distance = (away.square().sum(-1, keepdim=True) + SOFT_DISTANCE**2).sqrt()
        return position + self.offset * away / distance
