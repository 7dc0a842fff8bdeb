"""Time scale: the clock of the stamps runs too fast or too slowly."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient
from ballfg.dynamics.measurement import MeasurementEffect


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
