"""One observation of a stream with what is believed of it, and what taking it in did."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.launcher import SpinLabel
from ballfg.estimation.online.measurement import Measurement
from ballfg.estimation.smoother.motion import FLIGHT, Motion


@dataclass
class Sample:
    """One observation, and what is believed of it.

    Attributes:
        time: s.  position: (3,) m.
        stated: (3,) m, standard deviation of its white error as stated.
        whole: (3,) m, that of its whole error: with a lasting part and the error of the stamp.
        velocity: (3,) m/s, rough, along which the stamp's error moves it.
        factor: multiple of the whole error with which it takes part if it is not good; 1 if it is.
        motion: how the ball got here from the sample before.
        label: what is known of the spin, on the first sample of a track.
        slots: where iSAM2 keeps the sample's own factors: its position's first, where it was measured.
        bias_slot: where it keeps the factor that leads here from the bias of the sample before; None without.
        measured: whether the position was measured; if not, it was made from the measurements and helps to find events.
        measurements: everything else that was measured at this moment.
    """

    time: float
    position: Array
    stated: Array
    factor: float = 1.0
    motion: Motion = FLIGHT
    label: SpinLabel | None = None
    slots: tuple[int, ...] = ()
    bias_slot: int | None = None
    whole: Array = field(default_factory=lambda: np.zeros(3))
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    measured: bool = True
    measurements: list[Measurement] = field(default_factory=list)

    @property
    def sigma(self) -> Array:
        """(3,) m, standard deviation of the white error with which it takes part."""
        return self.stated if self.factor == 1.0 else self.whole * self.factor


@dataclass(frozen=True)
class Update:
    """What one update did.

    Attributes:
        innovation: (dim,) whitened, of the position or of what stands for it; NaN where nothing predicted the sample.
        evaluated: factors of the motion evaluated, the new one among them.
        calls: torch calls for them.
        variables: states that iSAM2 eliminated again.
    """

    innovation: Array
    evaluated: int
    calls: int
    variables: int
