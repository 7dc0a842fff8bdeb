"""Time offset: coordinates are read later than their stamp says."""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient
from ballfg.simulate.undeclared.base import Advance, MeasurementEffect


class TimeOffset(MeasurementEffect):
    """Each coordinate is where the ball is x, y or z seconds after the stamp.

    Cameras without a common shutter do that: the coordinate across one camera comes from another moment than the one
    along it. The same offset on all three is a shift of the clock, which tracks alone cannot show.
    """

    name = "time_offset"
    sentence = "The coordinates of one sample come from different moments: the cameras are not synchronous."
    coefficients = tuple(Coefficient(axis, 0.0, 0.002, "s", 0.0, 0.1) for axis in "xyz")
    x: Tensor
    y: Tensor
    z: Tensor

    def positions(self, states: Tensor, advance: Advance) -> Tensor:
        """(n, 3) m, each coordinate from its own moment; a contact on the way is passed through exactly."""
        columns = []
        for axis, offset in enumerate((self.x, self.y, self.z)):
            # a short cut for simulations; a derivative at zero needs the motion
            none = not torch.is_grad_enabled() and float(offset) == 0.0
            late = states if none else advance(states, offset.expand(len(states)))
            columns.append(late[:, axis])
        return torch.stack(columns, dim=-1)
