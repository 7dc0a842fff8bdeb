"""Spin label offset: the spins that labels state are wrong by a constant."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, vector
from ballfg.dynamics.measurement import MeasurementEffect


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
