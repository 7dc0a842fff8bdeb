"""Measurements and samples of a stream, and the belief after an update."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.estimation.launcher import SpinLabel
from ballfg.estimation.observations.innovation import FilterInnovation
from ballfg.estimation.observations.observation import Context, refuse_unknowns
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.motion import FLIGHT, Motion
from ballfg.factors.batch import FactorBatch, merge
from ballfg.factors.bridge import Bridge, checked
from ballfg.prediction.state import BallState
from ballfg.state import STATE_DIM
from ballfg.tracks import Track

if TYPE_CHECKING:
    import gtsam

    from ballfg.dynamics.model import BallModel


class Measurement:
    """One measurement of a state: a batch of one factor; `innovation` (dim,) whitened, NaN without a prediction."""

    def __init__(self, batch: FactorBatch) -> None:
        self.batch = batch
        self.bridge = Bridge(batch, on_miss="row")
        self.innovation = np.full(batch.dim, np.nan)

    def factor(self, state: int) -> gtsam.CustomFactor:
        """The factor on a state of the stream."""
        return self.bridge.factor(0, [state])

    def corrected(self, state: Array, covariance: Array) -> tuple[Array, Array]:
        """State (9,) and covariance (9, 9) after an extended Kalman filter's update with the measurement.

        A tracker's bias may follow the state; the measurement does not depend on it. A robust loss weights the update
        by the innovation, which is stored the first time.
        """
        found = FilterInnovation.of(self.batch, state, covariance)
        if np.isnan(self.innovation).any():
            self.innovation = found.whitened
        gain = np.linalg.solve(found.spread + found.R, found.H @ covariance).T
        return state - gain @ found.residual, covariance - gain @ found.H @ covariance


def prepare(measurements: Sequence[Measurement], states: Array) -> None:
    """Evaluates measurements at their states (k, 9), one call per kind, and stores the results for iSAM2's queries.

    Biases may follow the states.

    Raises: ValueError: if a residual is not finite: a ball is not in front of its camera, for instance.
    """
    groups: defaultdict[Hashable, list[int]] = defaultdict(list)
    for k, measurement in enumerate(measurements):
        groups[measurement.batch.group].append(k)
    for members in groups.values():
        batch = merge([measurements[k].batch for k in members])
        inputs = (np.ascontiguousarray(states[members, :STATE_DIM]),)
        residual, (jacobian,) = checked(batch, slice(None), inputs, *batch.compute(slice(None), inputs))
        for row, k in enumerate(members):
            measurements[k].bridge.keep(0, (inputs[0][row],), residual[row], (jacobian[row],))


def measurements_beside(
    track: Track, model: BallModel, settings: Settings, sigma: Array
) -> dict[str, list[tuple[int, Measurement]]]:
    """All measurements but positions, each with its sample's number, by the observation's name.

    Raises: ValueError: an observation of several states, or settings that give it unknowns.
    """
    refuse_unknowns(track.observations, settings, "online")
    context, found = Context(track, model, settings, sigma), {}
    for observation in track.observations:
        batch = observation.batch(context)
        if batch.variables.shape[1] > 1:
            raise ValueError(
                f"track {shown(track.name)}: the estimator 'online' takes observations of one state each; "
                f"'{observation.name}' looks at other variables too. Use the smoother."
            )
        found[observation.name] = [(k, Measurement(one)) for k, one in observation.single_rows(batch)]
    return found


@dataclass
class Sample:
    """One observation and its explanation.

    Attributes:
        time: s.  position: (3,) m.  stated: (3,) m, standard deviation of its white error as stated.
        whole: (3,) m, standard deviation of its whole error, with a lasting part and the error of the stamp.
        velocity: (3,) m/s, rough; the stamp's error displaces the sample along it.
        factor: multiple of the whole error for a sample that is not good; 1 for a good one.
        motion: how the ball got here from the sample before.  label: prior of the spin, on the first sample of a track.
        rolls: True on a first sample without a label that shows a ball on a surface, if it more probably rolled there.
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
    rolls: bool = False
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


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class OnlineState(BallState):
    """The state of the ball after a measurement, with a record of the update.

    Attributes:
        innovation: (3,) the position against its prediction, whitened, (2,) of a sighting; NaN without a prediction.
        motion: how the ball moved since the last observation.
        revised: number of last samples that were retracted and explained anew.
        rebuilt: True if iSAM2 failed and the window was rebuilt.
        status: OK, or a remedy.
    """

    innovation: Array
    motion: Motion
    revised: int
    rebuilt: bool
    status: Status
