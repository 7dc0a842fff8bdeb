"""Errors of spin labels: other axes or signs, a factor, a constant."""

import itertools

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, vector
from ballfg.dynamics.measurement import MeasurementEffect


class SpinLabelFrame(MeasurementEffect):
    """label = M spin with M = ((xx, xy, xz), (yx, yy, yz), (zx, zy, zz)), row by row; the identity at absence.

    Labels with exchanged or reversed axes have one of the `signed_permutations` for M.
    """

    name = "spin_label_frame"
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
    rank = 101

    def label(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as labelled."""
        rows = (vector(*(getattr(self, row + column) for column in "xyz")) for row in "xyz")
        return torch.cat([(row * spin).sum(-1, keepdim=True) for row in rows], dim=-1)


def signed_permutations() -> Tensor:
    """(48, 3, 3) all matrices that exchange and reverse axes, the identity first; half of them mirror."""
    eye = torch.eye(3, dtype=torch.float64)
    signs = [torch.tensor(s, dtype=torch.float64) for s in itertools.product((1.0, -1.0), repeat=3)]
    orders = [torch.tensor(order) for order in itertools.permutations(range(3))]
    return torch.stack([sign.unsqueeze(-1) * eye[order] for order in orders for sign in signs])


class SpinLabelScale(MeasurementEffect):
    """label = (1 + s) spin: another unit, a slipping wheel, a count of half turns."""

    name = "spin_label_scale"
    sentence = (
        "Spin labels are too large or too small by a factor: in flight the same as another Magnus coefficient, only "
        "bounces tell."
    )
    decide = "Film a mark on the ball, or use bounces that grip: they show the spin itself."
    coefficients = (Coefficient("s", 0.0, 0.1, "1", -10.0, 10.0),)
    rank = 102
    s: Tensor

    def label(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as labelled."""
        return (1.0 + self.s) * spin


class SpinLabelOffset(MeasurementEffect):
    """label = spin + (x, y, z), in the axes of the labels."""

    name = "spin_label_offset"
    sentence = (
        "Spin labels are wrong by one constant vector: in flight the same as a rotating room, whose Coriolis "
        "acceleration is the Magnus force of a constant extra spin."
    )
    decide = "Shoot without spin: what curves then is not in the labels' scale; film a mark on the ball."
    coefficients = tuple(Coefficient(axis, 0.0, 10.0, "rad/s", -2000.0, 2000.0) for axis in "xyz")
    rank = 103
    x: Tensor
    y: Tensor
    z: Tensor

    def label(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as labelled."""
        return spin + vector(self.x, self.y, self.z)
