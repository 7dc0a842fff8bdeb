"""Errors of the clock: coordinates or positions that are late, and a wrong length of the second."""

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, per_row, vector
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION, VELOCITY


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


class TimeScale(MeasurementEffect):
    """Written durations are 1 + s times the true ones: a frame rate that is not what the file takes it to be."""

    name = "time_scale"
    sentence = (
        "Written durations are too long or too short by a factor: the same as another g once drag and Magnus force, or "
        "the spin, are free."
    )
    decide = "Film a clock, or trust the local g: gravity then gives the scale of the time."
    coefficients = (Coefficient("s", 0.0, 0.01, "1", -0.5, 0.5),)
    rank = 100
    s: Tensor

    def true_stamps(self, stamps: Tensor) -> Tensor:
        """(...) s of true time."""
        return stamps / (1.0 + self.s)

    def stamps(self, times: Tensor) -> Tensor:
        """(...) s as written."""
        return times * (1.0 + self.s)


class VelocityLag(MeasurementEffect):
    """p - lag v in place of p, with the velocity at the stamp: what an extrapolating or smoothing tracker reports.

    Within a flight that is the track of a ball that started `lag` later, up to lag^2 / 2 times its acceleration (0.1 mm
    at 5 ms); what shows is the step of lag times the jump of the velocity at a contact.
    """

    name = "velocity_lag"
    sentence = (
        "Positions are reported late, by a lag times the velocity: within one flight the same as a shift of the clock."
    )
    decide = (
        "Let the ball bounce often and steeply: each bounce must show a step of the lag times the change of velocity."
    )
    coefficients = (Coefficient("lag", 0.0, 0.003, "s", -0.2, 0.2),)
    rank = 1
    lag: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, behind the ball."""
        return states[..., POSITION] - self.lag * states[..., VELOCITY]
