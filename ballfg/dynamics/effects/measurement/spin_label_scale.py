"""Spin label scale: the spins that labels state are wrong by a factor."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient
from ballfg.dynamics.measurement import MeasurementEffect


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
