"""Estimators for models whose measurements are not what happened: the measurement is undone before the estimation.

Only the forward map is asked, so any effect will do. With h(x) the position that is measured of a ball in state x, the
track is shifted by h(x) - p(x), x the states that the smoother finds in the shifted track, until the shift stays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.rollout import advance
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.measurement.as_measured import (
    LabelMap,
    measured_positions,
    plainly_measured,
    true_times,
    written_time,
)
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import Settings, sample_sigmas
from ballfg.estimation.smoother.pieces.long_tracks import PiecewiseSmoother
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import FactorBatch
from ballfg.state import POSITION, STATE_DIM
from ballfg.tracks import SPIN_LABELS, Track

ROUNDS: Final = 20
"""How often the track is estimated at most; a lag of 5 ms takes four or five rounds, an offset of 30 ms a dozen."""
FIRST_ROUNDS: Final = 8
"""Steps of the fixed point on positions alone: a map that stretches them by 10 % is then undone to 1e-8."""
SETTLED: Final = 1e-3
"""Standard deviations of a sample: shifts that change by less are the same."""
LOST: Final = 1e4
"""Standard deviations of a sample, tens of metres: shifts that change by more will not settle."""


@dataclass(frozen=True)
class Undone:
    """A track as it happened: stamps, positions and label.

    Attributes:
        track: shifted, on the true clock.
        estimate: of the smoother.
        settled: whether the shift stayed.
    """

    track: Track
    estimate: Estimate
    settled: bool


class InvertMeasurement(Estimator):
    """An estimator of true states from what a model with measurement effects has written down.

    Stamps of the result are as written, its states are true. The shift of a sample is found by the smoother for all
    estimators, from the whole track. What is neglected: that the shift of a sample is as uncertain as the state it is
    made from (by a lag times the velocity's standard deviation: 0.2 mm for 5 ms and 0.04 m/s), and that noise is
    stretched along with positions (by a per cent for a scale that is wrong by one). Hits within the time that a sample
    is spread over are not seen.

    Args:
        kind: the estimator.
        model: the ball, with measurement effects.  surfaces: what it may bounce on.  settings: noise and priors.

    Raises: ValueError: if the model's spin labels do not tell the spin; from `estimate`, for a track whose
        positions are rough.
    """

    name = "invert-measurement"
    undoes_measurement = True
    has_graph = True

    def __init__(self, kind: type[Estimator], model: BallModel, surfaces: Surfaces | float, settings: Settings) -> None:
        super().__init__(model, surfaces, settings)
        self.labels = LabelMap.of(model)
        own = replace(settings, spin_label_noise=settings.spin_label_noise / self.labels.gain)
        plain = plainly_measured(model)
        self.smoother = PiecewiseSmoother(plain, self.surfaces, own)
        self.inner = self.smoother if kind in (Smoother, PiecewiseSmoother) else kind(plain, self.surfaces, own)

    def estimate(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Estimate:
        """The true states at the written stamps; `NOT_CONVERGED` where the shifts did not settle."""
        written = self.prepared(track, factors)
        track = written.since_first()
        undone = self.undo(track)
        found = undone.estimate if self.inner is self.smoother else self.inner.estimate(undone.track)
        lost = found.status is Status.OK and not undone.settled
        contacts = (replace(c, time=written_time(self.model, 0.0, c.time)) for c in found.contacts)
        result = replace(
            found,
            times=track.times,
            contacts=tuple(contacts),
            world=self.world,
            status=Status.NOT_CONVERGED if lost else found.status,
        )
        return result.dated(written.times)

    def undo(self, track: Track) -> Undone:
        """The track as it happened, and what the smoother makes of it; of shifts that do not settle, the steadiest."""
        if track.rough:
            raise ValueError(
                "model must have no measurement effects for a track that cameras saw: they act on positions, and there "
                "are none. Leave the model's section measurement empty, or estimate from positions."
            )
        track = self._as_timed(track)
        sigma = sample_sigmas(self.settings, len(track), track.sigmas)
        shift = self._first_shift(track)
        best, least = None, np.inf
        for _ in range(ROUNDS):
            shifted = replace(track, positions=track.positions - shift)
            estimate = self.smoother.estimate(shifted)
            found = self._shift(estimate)
            change = float(np.nan_to_num(np.abs(found - shift) / sigma, nan=np.inf).max())
            if best is None or change < least:
                best, least = Undone(shifted, estimate, change <= SETTLED), change
            if change <= SETTLED or not change < LOST:
                break
            shift = found
        assert best is not None
        return best

    def _as_timed(self, track: Track) -> Track:
        """The track with its true stamps and spin label."""
        labels = track.labels
        if track.spin_label is not None:
            spin = self.labels.spin(track.spin_label)
            labels = {**labels, **dict(zip(SPIN_LABELS, spin.tolist(), strict=True))}
        return replace(track, times=true_times(self.model, track.times), labels=labels)

    def _first_shift(self, track: Track) -> Array:
        """(n, 3) m, of balls at rest where they were measured: right where the map asks for positions alone."""
        states = torch.zeros((len(track), STATE_DIM), dtype=torch.float64)
        written = torch.from_numpy(track.positions)
        shift = torch.zeros_like(written)
        for _ in range(FIRST_ROUNDS):
            states[:, POSITION] = written - shift
            with torch.no_grad():
                shift = self.model.measured(states, lambda _delay: states) - states[:, POSITION]
        return np.asarray(np.nan_to_num(shift.numpy(), posinf=0.0, neginf=0.0))

    def _shift(self, estimate: Estimate) -> Array:
        """(n, 3) m, by how much the estimated states are measured away from their positions."""
        states, model = torch.from_numpy(estimate.states), self.model
        if estimate.coefficient_names:
            augmented = AugmentedModel(model, estimate.coefficient_names)
            states, model = augmented.append(states, torch.from_numpy(estimate.coefficients)), augmented
        if len(states) > 1 and len(states) - 2 not in estimate.hits:
            states = torch.cat((states[:-1], self._last(model, states[-2:-1], estimate.times)))
        return (measured_positions(model, states, self.surfaces) - states[:, POSITION]).numpy()

    def _last(self, model: BallModel, before: Tensor, times: Array) -> Tensor:
        """(1, 9 + p) the last state, as it follows from the one before.

        No later sample tells on which side of a bounce the last one is. Shifted as if before it, a sample after it
        would go on looking like one before: the motion must decide.
        """
        with torch.no_grad():
            return advance(model, before, torch.from_numpy(np.diff(times[-2:])), self.surfaces)
