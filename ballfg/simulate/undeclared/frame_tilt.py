"""Frame tilt: the measured z axis is not plumb."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient
from ballfg.simulate.undeclared.base import Advance, MeasurementEffect


class FrameTilt(MeasurementEffect):
    """Positions turned about the origin by the rotation vector (x, y, 0); labels stay in the true frame."""

    name = "frame_tilt"
    sentence = "The frame of the measurements is tilted against the vertical."
    coefficients = tuple(Coefficient(axis, 0.0, 0.01, "rad", -0.5, 0.5) for axis in "xy")
    x: Tensor
    y: Tensor

    def positions(self, states: Tensor, advance: Advance) -> Tensor:
        """(n, 3) m, in the tilted frame."""
        zero = torch.zeros_like(self.x)
        generator = torch.stack(
            (
                torch.stack((zero, zero, self.y)),
                torch.stack((zero, zero, -self.x)),
                torch.stack((-self.y, self.x, zero)),
            )
        )
        return states[:, :3] @ torch.linalg.matrix_exp(generator).T
