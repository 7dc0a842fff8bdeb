"""Defines the effects on the recorded data: the clock, the frame of the positions, the spin labels."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ballfg.dynamics.effect import (
    SEEN,
    TINY_LENGTH,
    Coefficient,
    Range,
    Scene,
    Usual,
    coordinate,
    length,
    per_row,
    vector,
)
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION, VELOCITY

SOFT_DISTANCE: Final = 0.05
"""m. Nearer to its centre than this a radial bias falls to zero, so that it has a direction nowhere and a derivative
everywhere; 2 m away it is 0.03 % smaller than its coefficient."""


class TimeOffset(MeasurementEffect):
    """Each coordinate is read x, y or z seconds after the stamp, less the smallest of the three.

    Cameras without a common shutter do that: the coordinate across one camera comes from another moment than the one
    along it. The same offset on all three is a shift of the clock, which tracks cannot show; it is left out, so that
    offsets may be negative and delays are not.
    """

    name = "time_offset"
    plain = "cameras that are not synchronous"
    says = "The coordinates of one position are taken at different moments, up to {apart:milli} ms apart."
    sentence = (
        "The coordinates of one sample come from different moments: the cameras are not synchronous; the same offset "
        "on all three axes changes nothing."
    )
    decide = (
        "Flash a light before all cameras, or shoot along another axis: the lag of a coordinate grows with its speed."
    )
    coefficients = tuple(Coefficient(axis, 0.0, 0.002, "s", -0.1, 0.1) for axis in "xyz")
    plausible = Range(-0.03, 0.03, "two frames of a camera of 60 Hz")
    usual = Usual({"x": 0.002}, "an estimate: a quarter of a frame at 120 Hz")
    rank = 0

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, each coordinate from its own moment; a contact on the way is passed through exactly."""
        offsets = vector(self.x, self.y, self.z)
        delays = offsets - offsets.amin(-1, keepdim=True)
        columns = [later(per_row(delays[..., axis : axis + 1]))[..., axis] for axis in range(3)]
        return torch.stack(columns, dim=-1)


class VelocityLag(MeasurementEffect):
    """p - lag v in place of p, with the velocity at the stamp: what an extrapolating or smoothing tracker reports.

    Within a flight that is the track of a ball that started `lag` later, up to lag^2 / 2 times its acceleration (0.1 mm
    at 5 ms); what shows is the step of lag times the jump of the velocity at a contact.
    """

    name = "velocity_lag"
    plain = "positions that are reported late"
    says = "Positions are reported {lag:milli} ms too {lag:late|early}."
    imitated = True
    sentence = (
        "Positions are reported late, by a lag times the velocity: within one flight the same as a shift of the clock."
    )
    decide = (
        "Let the ball bounce often and steeply: each bounce must show a step of the lag times the change of velocity."
    )
    coefficients = (Coefficient("lag", 0.0, 0.003, "s", -0.2, 0.2),)
    plausible = Range(-0.1, 0.1, "a tracker's filter delays by a few frames")
    usual = Usual({"lag": 0.003}, "an estimate: a third of a frame at 120 Hz")
    rank = 1

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, behind the ball."""
        return states[..., POSITION] - self.lag * states[..., VELOCITY]


class FrameTilt(MeasurementEffect):
    """Positions turned about the origin by the rotation vector (x, y, 0); labels stay in the true frame."""

    name = "frame_tilt"
    plain = "axes that are not level"
    says = "The axes of the measurements lean by {degrees} against the vertical."
    sentence = (
        "The frame of the measurements is tilted against the vertical: the same as a gravity that leans the other way "
        "and a table that tilts."
    )
    decide = "Film a plumb line, or a ball rolling on a levelled table."
    coefficients = tuple(Coefficient(axis, 0.0, 0.01, "rad", -0.5, 0.5) for axis in "xy")
    plausible = Range(-0.1, 0.1, SEEN)
    usual = Usual({"y": 0.0087}, "an estimate: half a degree")
    rank = 10

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
    plain = "lengths that are wrong by a factor"
    says = "Measured lengths are {axes:long|short}."
    sentence = (
        "Measured lengths are too long or too short by a factor along each axis; the same factor on all is another g, "
        "drag, radius and table height."
    )
    decide = "Measure a rod of known length along each axis."
    coefficients = tuple(Coefficient(axis, 0.0, 0.01, "1", -0.5, 0.5) for axis in "xyz")
    plausible = Range(-0.1, 0.1, SEEN)
    usual = Usual({"x": 0.01}, "an estimate: 1 %")
    rank = 11

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, stretched."""
        return states[..., POSITION] * (1.0 + vector(self.x, self.y, self.z))


class RadialBias(MeasurementEffect):
    """Positions moved away from a centre c, such as a camera: p + offset d / sqrt(|d|^2 + soft^2) with d = p - c."""

    name = "radial_bias"
    plain = "positions pushed away from one place"
    says = "Positions lie {offset:milli} mm too {offset:far from|near to} one place, such as a camera."
    sentence = "Positions lie a constant distance too far from one place, as with a wrong range of a camera."
    decide = "Measure a ball at rest in several known places: the error points away from the centre."
    coefficients = (
        Coefficient("offset", 0.0, 0.005, "m", -0.5, 0.5),
        *(coordinate(axis, 0.0, 1.0) for axis in "xyz"),
    )
    plausible = Range(-0.02, 0.02, "a camera sees the surface, which lies one radius before the centre")
    usual = Usual({"offset": 0.01}, "an estimate: half of a ball's radius")
    rank = 12

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, pushed outwards."""
        position = states[..., POSITION]
        away = position - vector(self.x, self.y, self.z)
        distance = (away.square().sum(-1, keepdim=True) + SOFT_DISTANCE**2).sqrt()
        return position + self.offset * away / distance


class Distortion(MeasurementEffect):
    """Positions stretched from a centre c, the more the farther away: c + d (1 + k |d|^2) with d = p - c."""

    name = "distortion"
    plain = "positions stretched as by a lens"
    says = "Positions are stretched by place, as by a badly calibrated lens."
    sentence = (
        "Positions are stretched or compressed smoothly by place, as with a lens or cameras that were calibrated in "
        "the middle of the room only; near the middle nothing of it shows."
    )
    decide = "Measure rods of known length, or a ball at rest in known places, in the room's middle and at its edges."
    coefficients = (
        Coefficient("k", 0.0, 0.005, "1/m^2", -0.5, 0.5),
        *(coordinate(axis, 0.0, 0.5) for axis in "xyz"),
    )
    plausible = Range(-0.05, 0.05, SEEN)
    usual = Usual({"k": 0.008}, "an estimate: 8 mm at 1 m from the centre")
    rank = 13

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """About the middle of the space that the data fill, and about its corners: a fit finds only a centre nearby."""
        low, high = np.array(scene.low), np.array(scene.high)
        corners = [np.where(upper, high, low) for upper in itertools.product((False, True), repeat=3)]
        centers = [0.5 * (low + high), *corners]
        return [dict(zip("xyz", map(float, center), strict=True)) for center in centers]

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, stretched about the centre."""
        center = vector(self.x, self.y, self.z)
        away = states[..., POSITION] - center
        return center + away * (1.0 + self.k * away.square().sum(-1, keepdim=True))


class TimeScale(MeasurementEffect):
    """Written durations are 1 + s times the true ones: a frame rate that is not what the file takes it to be."""

    name = "time_scale"
    plain = "a clock that runs wrong"
    says = "The clock is wrong: durations are written {s:%} too {s:long|short}."
    imitated = True
    sentence = (
        "Written durations are too long or too short by a factor: the same as another g once drag and Magnus force, or "
        "the spin, are free."
    )
    decide = "Film a clock, or trust the local g: gravity then gives the scale of the time."
    coefficients = (Coefficient("s", 0.0, 0.01, "1", -0.9, 9.0),)
    plausible = Range(-0.88, 7.0, "cameras of 30 to 240 Hz taken for one another")
    usual = Usual({"s": 0.01}, "an estimate: 1 %")
    rank = 100

    def true_stamps(self, stamps: Tensor) -> Tensor:
        """(...) s of true time."""
        return stamps / (1.0 + self.s)

    def stamps(self, times: Tensor) -> Tensor:
        """(...) s as written."""
        return times * (1.0 + self.s)


class CountedFrames(MeasurementEffect):
    """Stamps count the frames that were kept: for each sample, `missing` frames were dropped on average.

    Which frames are missing is not in the stamps, so that the effect itself is a clock that runs slow on average. A
    diagnosis sees them in the tracks, by steps of the ball that are twice as long as their neighbours.
    """

    name = "counted_frames"
    plain = "stamps that miss dropped frames"
    says = "The stamps count frames although frames were dropped, {missing:.2g} for each one kept."
    sentence = (
        "Stamps count the frames that were kept although frames were dropped between them: on average the same as a "
        "time scale, but steps of the ball are of one, two or three frames' length."
    )
    decide = "Write down the camera's own frame numbers, or the times of its exposures, beside the stamps."
    coefficients = (Coefficient("missing", 0.0, 0.1, "1", 0.0, 9.0),)
    plausible = Range(0.0, 6.0, "of seven frames one is kept")
    rank = 100

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """None: residuals show its mean only, which is a time scale."""
        return ()

    def true_stamps(self, stamps: Tensor) -> Tensor:
        """(...) s of true time, on average."""
        return stamps * (1.0 + self.missing)

    def stamps(self, times: Tensor) -> Tensor:
        """(...) s as written, on average."""
        return times / (1.0 + self.missing)


class SpinLabelFrame(MeasurementEffect):
    """label = M spin with M = ((xx, xy, xz), (yx, yy, yz), (zx, zy, zz)), row by row; the identity at absence.

    Labels with exchanged or reversed axes have one of the `signed_permutations` for M.
    """

    name = "spin_label_frame"
    plain = "spin labels in other axes"
    says = "The spin labels are given in other axes, or with other signs, than the positions."
    sentence = (
        "Spin labels are given in other axes or with other signs than the positions; a multiple of the identity is a "
        "spin label scale."
    )
    decide = "Shoot with pure topspin, then pure sidespin, and compare the way the balls curve with their labels."
    coefficients = tuple(
        Coefficient(row + column, float(row == column), 0.5, "1", -10.0, 10.0, absent=float(row == column))
        for row in "xyz"
        for column in "xyz"
    )
    usual = Usual({"yy": -2.0}, "one axis is reversed", graded=False)
    rank = 101

    def label(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as labelled."""
        rows = (vector(*(getattr(self, row + column) for column in "xyz")) for row in "xyz")
        return torch.cat([(row * spin).sum(-1, keepdim=True) for row in rows], dim=-1)


class SpinLabelScale(MeasurementEffect):
    """label = (1 + s) spin: another unit, a slipping wheel, a count of half turns."""

    name = "spin_label_scale"
    plain = "spin labels wrong by a factor"
    says = "The spin labels are {s:%} too {s:large|small}."
    sentence = (
        "Spin labels are too large or too small by a factor: in flight the same as another Magnus coefficient, only "
        "bounces tell."
    )
    decide = "Film a mark on the ball, or use bounces that grip: they show the spin itself."
    coefficients = (Coefficient("s", 0.0, 0.1, "1", -10.0, 10.0),)
    usual = Usual({"s": 0.1}, "an estimate: 10 %, as of a wheel that slips")
    rank = 102

    def label(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as labelled."""
        return (1.0 + self.s) * spin


class SpinLabelOffset(MeasurementEffect):
    """label = spin + (x, y, z), in the axes of the labels."""

    name = "spin_label_offset"
    plain = "spin labels wrong by a constant"
    says = "All spin labels are off by the same {size:.2g} rad/s {direction}."
    sentence = (
        "Spin labels are wrong by one constant vector: in flight the same as a rotating room, whose Coriolis "
        "acceleration is the Magnus force of a constant extra spin."
    )
    decide = "Shoot without spin: what curves then is not in the labels' scale; film a mark on the ball."
    coefficients = tuple(Coefficient(axis, 0.0, 10.0, "rad/s", -2000.0, 2000.0) for axis in "xyz")
    usual = Usual({"y": 15.0}, "an estimate: a wheel that turns 2.4 times a second too fast")
    rank = 103

    def label(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as labelled."""
        return spin + vector(self.x, self.y, self.z)


def signed_permutations() -> Tensor:
    """(48, 3, 3) all matrices that exchange and reverse axes, the identity first; half of them mirror."""
    eye = torch.eye(3, dtype=torch.float64)
    signs = [torch.tensor(s, dtype=torch.float64) for s in itertools.product((1.0, -1.0), repeat=3)]
    orders = [torch.tensor(order) for order in itertools.permutations(range(3))]
    return torch.stack([sign.unsqueeze(-1) * eye[order] for order in orders for sign in signs])
