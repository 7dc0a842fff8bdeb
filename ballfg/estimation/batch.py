"""Many tracks on several cores, one after the other out of a stream into a stream; and a few long tasks."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import joblib
import torch

from ballfg.estimation.estimator import Estimator
from ballfg.estimation.result import Estimate
from ballfg.tracks import Track

R = TypeVar("R")
_started: set[int] = set()
"""Numbers of processes that were started in this one; joblib keeps them for minutes."""

PROBED = 10
"""Tracks done in this process first, to see how long one takes; the first of them warms up and does not count."""
START_UP = 5.0
"""s that worker processes take to start (they import torch and gtsam): less work than that stays here."""
HAND_OVER = 0.3
"""s that it takes to hand work to processes that were started before."""
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
        jobs = jobs if left * (1.0 - 1.0 / jobs) > (HAND_OVER if jobs in _started else START_UP) else 1
    if jobs == 1:
        yield from map(function, stream)
        return
    _started.add(jobs)
    batch = min(BATCH, max(1, -(-(count - PROBED) // (2 * jobs))))
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator", pre_dispatch=f"{2 * batch}*n_jobs", batch_size=batch)
    yield from parallel(joblib.delayed(_on_one_thread)(function, track) for track in stream)


def do_all(tasks: Sequence[Callable[[], R]], jobs: int) -> list[R]:
    """The results of tasks that take seconds each, in their order.

    Args:
        tasks: functions without arguments (`functools.partial`), which must pickle.
        jobs: processes; with fewer than two of them, or of tasks, all are done in this process.
    """
    if min(jobs, len(tasks)) < 2:
        return [task() for task in tasks]
    _started.add(jobs)
    return list(joblib.Parallel(n_jobs=jobs)(joblib.delayed(_on_one_thread)(task) for task in tasks))


def _on_one_thread(function: Callable[..., R], *arguments: object) -> R:
    torch.set_num_threads(1)  # the processes share the cores already
    return function(*arguments)
