"""Inverts measurement effects before the estimation, for models whose measurements differ from the true motion.

Only the forward map is used, so any effect will do. With h(x) the measured position of a ball in state x, the track is
shifted by h(x) - p(x) until the shift converges; x are the smoother's states of the shifted track.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.deferred import torch
from ballfg.dynamics.compiled.kept_model import augmented
from ballfg.dynamics.motion.arrays import roll_out
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.measurement import as_measured
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import WIDEST_PRIOR, Settings, sample_sigmas
from ballfg.estimation.smoother.smoother import PiecewiseSmoother, Smoother
from ballfg.factors.batch import FactorBatch
from ballfg.state import POSITION, STATE_DIM
from ballfg.tracks import Track
from ballfg.tracks.track import FASTEST_SPIN, SPIN_LABELS

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

ROUNDS: Final = 20
"""Largest number of estimates of a track; a lag of 5 ms takes four or five, an offset of 30 ms a dozen."""
FIRST_ROUNDS: Final = 8  # Steps of the fixed point on positions alone: they undo a stretch by 10 % to 1e-8
SETTLED: Final = 1e-3  # Standard deviations of a sample: shifts that change by less have converged
IMPOSSIBLE: Final = (
    f"the model reads the spin label as more than {FASTEST_SPIN:g} rad/s, as no ball spins: the label is not used"
)
LOST: Final = 1e4  # Standard deviations of a sample, tens of metres: shifts that change by more diverge


@dataclass(frozen=True)
class Undone:
    """The true track: shifted, on the true clock; the estimate of the smoother; True if the shift converged."""

    track: Track
    estimate: Estimate
    settled: bool


class InvertMeasurement(Estimator):
    """Estimates true states from the records of a model with measurement effects.

    Stamps of the result are the recorded ones, its states are true. The smoother finds the shift of a sample for all
    estimators, from the whole track. Two errors are neglected: the shift of a sample is as uncertain as its state (a
    lag times the velocity's standard deviation: 0.2 mm for 5 ms and 0.04 m/s), and noise is stretched along with
    positions (by a per cent for a scale that is wrong by one). Hits within the time that a sample spans are not seen.

    Args:
        kind: the estimator.
        model: the ball, with measurement effects.  surfaces: table and floor.  settings: noise and priors.

    Raises: ValueError: if the model's spin labels do not determine the spin; from `estimate`, for a track whose
        positions are rough.
    """

    name = "invert-measurement"
    undoes_measurement = True
    has_graph = True

    def __init__(self, kind: type[Estimator], model: BallModel, surfaces: Surfaces | float, settings: Settings) -> None:
        super().__init__(model, surfaces, settings)
        self.labels = as_measured.LabelMap.of(model)
        # labels that hold almost nothing of the spin say as little as may be
        spread = min(self.labels.spread(settings.spin_label_noise, settings.spin_prior), WIDEST_PRIOR)
        own = replace(settings, spin_label_noise=spread)
        plain = as_measured.plainly_measured(model)
        self.smoother = PiecewiseSmoother(plain, self.surfaces, own)
        self.inner = self.smoother if kind in (Smoother, PiecewiseSmoother) else kind(plain, self.surfaces, own)

    def estimate(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Estimate:
        """The true states at the recorded stamps; `NOT_CONVERGED` if the shifts did not converge."""
        written = self.prepared(track, factors)
        track = written.since_first()
        undone = self.undo(track)
        found = undone.estimate if self.inner is self.smoother else self.inner.estimate(undone.track)
        lost = found.status is Status.OK and not undone.settled
        contacts = (replace(c, time=as_measured.written_time(self.model, 0.0, c.time)) for c in found.contacts)
        result = replace(
            found,
            times=track.times,
            contacts=tuple(contacts),
            world=self.world,
            status=Status.NOT_CONVERGED if lost else found.status,
            notes=found.notes + (IMPOSSIBLE,) * (track.spin_label is not None and undone.track.spin_label is None),
        )
        return result.dated(written.times)

    def undo(self, track: Track) -> Undone:
        """The true track and the smoother's estimate of it; if shifts do not converge, the steadiest."""
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
        """The track with its true stamps and spin label; without a label that stands for a spin of no ball."""
        labels = track.labels
        if track.spin_label is not None:
            spin = self.labels.spin(track.spin_label, self.settings.spin_label_noise, self.settings.spin_prior)
            labels = {name: value for name, value in labels.items() if name not in SPIN_LABELS}
            if np.abs(spin).max() <= FASTEST_SPIN:
                labels |= dict(zip(SPIN_LABELS, spin.tolist(), strict=True))
        return replace(track, times=as_measured.true_times(self.model, track.times), labels=labels)

    def _first_shift(self, track: Track) -> Array:
        """(n, 3) m, of balls at rest at the measured positions: exact for a map of positions alone."""
        states = torch.zeros((len(track), STATE_DIM), dtype=torch.float64)
        written = torch.from_numpy(track.positions)
        shift = torch.zeros_like(written)
        for _ in range(FIRST_ROUNDS):
            states[:, POSITION] = written - shift
            with torch.no_grad():
                shift = self.model.measured(states, lambda _delay: states) - states[:, POSITION]
        return np.asarray(np.nan_to_num(shift.numpy(), posinf=0.0, neginf=0.0))

    def _shift(self, estimate: Estimate) -> Array:
        """(n, 3) m, distance between the measured and the true positions of the estimated states."""
        states, model = estimate.states, self.model
        if estimate.coefficient_names:
            states = np.concatenate((states, np.tile(estimate.coefficients, (len(states), 1))), axis=1)
            model = augmented(model, estimate.coefficient_names)
        if len(states) > 1 and len(states) - 2 not in estimate.hits:
            # no later sample tells on which side of a bounce the last one is: shifted as if before it, a sample after
            # it would still look like one before, so that the motion must decide
            moved = roll_out(model, states[-2:-1], np.diff(estimate.times[-2:])[None], self.surfaces)
            states = np.concatenate((states[:-1], moved[:, 0]))
        return as_measured.measured_positions(model, states, self.surfaces) - states[:, POSITION]
