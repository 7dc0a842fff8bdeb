"""The table's true place: another height than the declared one, or a tilt."""

import torch
from torch import Tensor

from ballfg.dynamics.effect import TINY_LENGTH, BounceEffect, Coefficient, length, vector


class TableHeight(BounceEffect):
    """Surfaces lie `offset` above their declared height.

    In measured tracks the bounce lies 2 to 4 mm lower than a rigid ball on the declared table would (docs/physics.md):
    calibration, and the ball's compression during a contact of about 1 ms.
    """

    name = "table_height"
    sentence = "Surfaces lie higher or lower than declared."
    decide = "Lay the ball on the table and measure its position; vary the steepness of the impacts."
    coefficients = (Coefficient("offset", 0.0, 0.004, "m", -0.2, 0.2, varies=True),)
    offset: Tensor

    def surface_offset(self, position: Tensor) -> Tensor:
        """() or (..., 1) m."""
        return self.offset


class TableTilt(BounceEffect):
    """Surfaces turned by the rotation vector (x, y, 0) about the point at their declared height over the origin.

    The plane through that point has the normal exp((x, y, 0)) z and the slope (-y, x) tan(angle) / angle. A ball
    touches it where its centre is one radius away from it, and bounces along its normal.
    """

    name = "table_tilt"
    sentence = (
        "The table is not level: bounces lean to one side; over one place of impact its height is the same as that of "
        "the table."
    )
    decide = "Put a level on the table, or bounce the ball in several places: a tilted frame bends flights too."
    coefficients = tuple(Coefficient(axis, 0.0, 0.005, "rad", -0.3, 0.3) for axis in "xy")
    x: Tensor
    y: Tensor

    def surface_offset(self, position: Tensor) -> Tensor:
        """(..., 1) m, the plane's height below the ball less that over the origin."""
        return (self.surface_slope(position) * position[..., :2]).sum(-1, keepdim=True)

    def surface_slope(self, position: Tensor) -> Tensor:
        """(2,) or (..., 2), the same everywhere."""
        angle = length(vector(self.x, self.y)).clamp_min(TINY_LENGTH)
        return (torch.tan(angle) / angle) * vector(-self.y, self.x)
