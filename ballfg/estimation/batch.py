"""Many tracks on several cores, one after the other out of a stream into a stream."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import TypeVar

import joblib
import torch

from ballfg.estimation.estimator import Estimator
from ballfg.estimation.result import Estimate
from ballfg.tracks import Track

R = TypeVar("R")

PROBED = 10
"""Tracks done in this process first, to see how long one takes; the first of them warms up and does not count."""
START_UP = 5.0
"""s that worker processes take to start (they import torch and gtsam): less work than that stays here."""
BATCH = 16
"""Tracks that go to a worker together, with one copy of the function."""


def estimate_tracks(estimator: Estimator, tracks: Iterable[Track], count: int, jobs: int) -> Iterator[Estimate]:
    """Estimates in the order of the tracks: `map_tracks` of an estimator."""
    if estimator.model.variations:  # the world of each estimate is that of its track
        yield from map_tracks(estimator.estimate, tracks, count, jobs)
        return
    for estimate in map_tracks(partial(_without_world, estimator), tracks, count, jobs):
        yield replace(estimate, world=estimator.world)


def _without_world(estimator: Estimator, track: Track) -> Estimate:
    """The estimate without the model, which need not travel between processes with every track."""
    return replace(estimator.estimate(track), world=None)


def map_tracks(function: Callable[[Track], R], tracks: Iterable[Track], count: int, jobs: int) -> Iterator[R]:
    """A function of each track, in the order of the tracks, a few tracks ahead of what is taken.

    Worker processes are started only where they save more time than they take to start.

    Args:
        function: copied to every process, so it must pickle.
        tracks: a stream; it is never held as a whole.
        count: how many tracks there are, about.
        jobs: processes; 1 stays in this one.
    """
    stream = iter(tracks)
    if jobs > 1:
        spent = 0.0
        for i in range(PROBED):
            track = next(stream, None)
            if track is None:
                return
            start = time.perf_counter()
            result = function(track)
            spent += (time.perf_counter() - start) * (i > 0)
            yield result
        left = spent / (PROBED - 1) * (count - PROBED)
        jobs = jobs if left * (1.0 - 1.0 / jobs) > START_UP else 1
    if jobs == 1:
        yield from map(function, stream)
        return
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator", pre_dispatch=f"{2 * BATCH}*n_jobs", batch_size=BATCH)
    yield from parallel(joblib.delayed(_on_one_thread)(function, track) for track in stream)


def _on_one_thread(function: Callable[[Track], R], track: Track) -> R:
    torch.set_num_threads(1)  # the processes share the cores already
    return function(track)
