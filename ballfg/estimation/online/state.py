"""Samples of a stream with their explanation, the record of an update, and the belief after it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.launcher import SpinLabel
from ballfg.estimation.online.measurement import Measurement
from ballfg.estimation.result import Status
from ballfg.estimation.smoother.motion import FLIGHT, Motion
from ballfg.prediction.state import BallState


@dataclass
class Sample:
    """One observation and its explanation.

    Attributes:
        time: s.  position: (3,) m.  stated: (3,) m, standard deviation of its white error as stated.
        whole: (3,) m, standard deviation of its whole error, with a lasting part and the error of the stamp.
        velocity: (3,) m/s, rough; the stamp's error displaces the sample along it.
        factor: multiple of the whole error for a sample that is not good; 1 for a good one.
        motion: how the ball got here from the sample before.  label: prior of the spin, on the first sample of a track.
        slots: places in iSAM2 of the sample's own factors: its position's first, if it was measured.
        bias_slot: place of the factor from the previous sample's bias to this one's; None without.
        measured: True if the position was measured; else it was computed from the measurements to find events.
        measurements: all other measurements of this moment.
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
        """(3,) m, standard deviation of the white error in its factor."""
        return self.stated if self.factor == 1.0 else self.whole * self.factor


@dataclass(frozen=True)
class Update:
    """The results and costs of one update.

    Attributes:
        innovation: (dim,) whitened, of the position or of its substitute; NaN without a prediction.
        evaluated, calls: factors of the motion, including the new one, and torch calls for them.
        variables: number of states that were eliminated again.
    """

    innovation: Array
    evaluated: int
    calls: int
    variables: int


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class OnlineState(BallState):
    """The state of the ball after a measurement, with a record of the update.

    Attributes:
        innovation: (3,) the position against its prediction, whitened, (2,) of a sighting; NaN without a prediction.
        motion: how the ball moved since the last observation.
        revised: number of last samples that were retracted and explained anew.
        evaluated: number of evaluated factors of the motion.  calls: number of torch calls for them.
        rebuilt: True if iSAM2 failed and the window was rebuilt.
        status: OK, or a remedy.
    """

    innovation: Array
    motion: Motion
    revised: int
    evaluated: int
    calls: int
    rebuilt: bool
    status: Status
