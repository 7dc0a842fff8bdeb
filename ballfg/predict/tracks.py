"""Prediction of whole tracks: observe the first part, predict the position at every later stamp."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.estimate.batch import estimate_tracks
from ballfg.estimate.estimator import Estimator
from ballfg.estimate.result import Estimate, Status
from ballfg.predict.belief import Belief
from ballfg.predict.propagate import Propagator
from ballfg.state import POSITION
from ballfg.tracks import Track

Array = NDArray[np.float64]

BLOCK = 64
"""Tracks that are propagated together; memory grows with it."""
STAMP_TOLERANCE = 1e-9
"""s. A stamp this little after the end of the observed part belongs to it."""


@dataclass(frozen=True)
class TrackPrediction:
    """Where the ball of one track will be.

    Attributes:
        name: of the track.
        times: (k,) s, the stamps after the observed part; none if the track ends before.
        positions: (k, 3) m.
        sigmas: (k, 3) m, of a measured position: state and measurement noise.
        measured: (k, 3) m, what the track has at those stamps.
        estimate: from the observed part.
    """

    name: str
    times: Array
    positions: Array
    sigmas: Array
    measured: Array
    estimate: Estimate

    @property
    def status(self) -> Status:
        """How the estimation of the observed part ended."""
        return self.estimate.status


def predict_tracks(
    estimator: Estimator, tracks: Iterable[Track], count: int, observe: float, *, horizon: float = np.inf, jobs: int = 1
) -> Iterator[TrackPrediction]:
    """Predictions in the order of the tracks.

    Args:
        estimator: from what it sees of a track comes the belief that is propagated.
        tracks: a stream; some tens at a time are in memory.
        count: how many there are, about.
        observe: s from the track's first stamp.
        horizon: s after the observed part; later stamps are left out.
        jobs: processes for the estimation.

    Raises: ValueError: if observe is not positive.
    """
    if not observe > 0.0:
        raise ValueError(f"observe must be positive seconds; got {observe:g}")
    propagator = Propagator(estimator.surfaces, estimator.settings.process)
    waiting: list[Track] = []

    def observed() -> Iterator[Track]:
        for track in tracks:
            waiting.append(track)
            yield track.until(float(track.times[0]) + observe + STAMP_TOLERANCE)

    estimates = estimate_tracks(estimator, observed(), count, jobs)
    while block := list(islice(estimates, BLOCK)):
        whole, waiting[: len(block)] = waiting[: len(block)], []
        yield from _predict_block(estimator, propagator, block, whole, horizon)


def _predict_block(
    estimator: Estimator, propagator: Propagator, estimates: list[Estimate], tracks: list[Track], horizon: float
) -> Iterator[TrackPrediction]:
    ends = np.array([e.times[-1] for e in estimates])
    later = [(t.times > end) & (t.times <= end + horizon + STAMP_TOLERANCE) for t, end in zip(tracks, ends, strict=True)]
    counts = [int(mask.sum()) for mask in later]
    times = np.repeat(ends[:, None], max(counts), axis=1)
    for row, track, mask, k in zip(times, tracks, later, counts, strict=True):
        row[:k] = track.times[mask]
        row[k:] = row[k - 1] if k else row[k:]  # short tracks wait at their last stamp
    belief = Belief.last(estimator.model, estimates)
    rolled = propagator.rollout(belief, torch.from_numpy(times)) if max(counts) else None
    for i, (track, result, mask, k) in enumerate(zip(tracks, estimates, later, counts, strict=True)):
        positions, sigmas = np.zeros((0, 3)), np.zeros((0, 3))
        if rolled is not None and k:
            noise = np.array(estimator.settings.position_noise) if track.sigmas is None else track.sigmas[mask]
            variance = torch.diagonal(rolled.covariances[i, :k], dim1=-2, dim2=-1)[:, POSITION].numpy()
            positions, sigmas = rolled.states[i, :k, POSITION].numpy(), np.sqrt(variance + noise**2)
        yield TrackPrediction(track.name, track.times[mask], positions, sigmas, track.positions[mask], result)
