"""Radial bias: the ball is seen too far from one place, or too near to it."""

from __future__ import annotations

from typing import Final

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, vector
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION

SOFT_DISTANCE: Final = 0.05
"""m. Nearer to the centre than this the bias falls to zero, so that it has a direction nowhere and a derivative
everywhere; 2 m away it is 0.03 % smaller than its coefficient."""


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
