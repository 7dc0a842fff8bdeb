"""Many tracks on several cores, one after the other out of a stream into a stream."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import joblib
import torch

from ballfg.estimate.estimator import Estimator
from ballfg.estimate.result import Estimate
from ballfg.tracks import Track

FEW_TRACKS = 20
"""Below it starting worker processes takes longer than the work."""


def estimate_tracks(estimator: Estimator, tracks: Iterable[Track], count: int, jobs: int) -> Iterator[Estimate]:
    """Estimates in the order of the tracks, a few tracks ahead of what is taken.

    Args:
        estimator: copied to every process.
        tracks: a stream; it is never held as a whole.
        count: how many tracks there are, about.
        jobs: processes; 1 stays in this one.
    """
    if jobs == 1 or count < FEW_TRACKS:
        yield from map(estimator.estimate, tracks)
        return
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator", pre_dispatch="4*n_jobs", batch_size=4)
    yield from parallel(joblib.delayed(_estimate)(estimator, track) for track in tracks)


def _estimate(estimator: Estimator, track: Track) -> Estimate:
    torch.set_num_threads(1)  # the processes share the cores already
    return estimator.estimate(track)
