"""Time offset: the coordinates of a sample come from different moments."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, per_row, vector
from ballfg.dynamics.measurement import Later, MeasurementEffect


class TimeOffset(MeasurementEffect):
    """Each coordinate is read x, y or z seconds after the stamp, less the smallest of the three.

    Cameras without a common shutter do that: the coordinate across one camera comes from another moment than the one
    along it. The same offset on all three is a shift of the clock, which tracks cannot show; it is left out, so that
    offsets may be negative and delays are not.
    """

    name = "time_offset"
    sentence = (
        "The coordinates of one sample come from different moments: the cameras are not synchronous; the same offset "
        "on all three axes changes nothing."
    )
    decide = (
        "Flash a light before all cameras, or shoot along another axis: the lag of a coordinate grows with its speed."
    )
    coefficients = tuple(Coefficient(axis, 0.0, 0.002, "s", -0.1, 0.1) for axis in "xyz")
    rank = 0
    x: Tensor
    y: Tensor
    z: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, each coordinate from its own moment; a contact on the way is passed through exactly."""
        offsets = vector(self.x, self.y, self.z)
        delays = offsets - offsets.amin(-1, keepdim=True)
        columns = [later(per_row(delays[..., axis : axis + 1]))[..., axis] for axis in range(3)]
        return torch.stack(columns, dim=-1)
