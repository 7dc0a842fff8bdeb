"""Runs a function over a stream of tracks or a few long tasks, in one process, several, or on a cluster."""

import operator
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import TypeVar

from ballfg.estimation.estimator import Estimator
from ballfg.estimation.flights.estimates import estimated
from ballfg.estimation.result import Estimate
from ballfg.parallel.executor import executor
from ballfg.parallel.parts import with_jobs
from ballfg.parallel.processes import Processes
from ballfg.parallel.stream import finished, in_order
from ballfg.parallel.work import each, on_one_thread
from ballfg.tracks import Track

T = TypeVar("T")
R = TypeVar("R")

PROBED = 9  # Tracks that are done in this process first, to time one
START_UP = 5.0
"""s until worker processes help (they import torch and gtsam): less work stays in this process. Many short calls count
together: none of them is worth it by itself."""
MANY = 500  # Estimates that usually take as long: 10 ms each
_spent = 0.0  # s of work so far that worker processes could have shared, had they been there


def estimate_tracks(
    estimator: Estimator, tracks: Iterable[Track], count: int, jobs: int, flights: bool = False
) -> Iterator[Estimate]:
    """Estimates in the order of the tracks; arguments as for `map_tracks`.

    Args: flights: True if tracks may hold more than flights, which are then looked for.
    """
    made = partial(estimated, estimator) if flights else estimator.estimate
    if estimator.model.variations:  # the world of an estimate depends on its track
        yield from map_tracks(made, tracks, count, jobs)
        return
    for estimate in map_tracks(partial(_without_world, made), tracks, count, jobs):
        yield replace(estimate, world=estimator.world)


def _without_world(made: Callable[[Track], Estimate], track: Track) -> Estimate:
    """The estimate without its model, so that processes need not send it with every track."""
    return replace(made(track), world=None)


def start_early(count: int, jobs: int) -> None:
    """Starts the processes for many estimates: they load their libraries while this one does what comes first."""
    others = executor(jobs)
    if isinstance(others, Processes) and count >= MANY and not others.started:
        others.start(__name__)


def map_tracks(function: Callable[[Track], R], tracks: Iterable[Track], count: int, jobs: int) -> Iterator[R]:
    """A function of each track, in the order of the tracks, a few tracks ahead of the consumer.

    Worker processes are started only if they save more time than they take to start. A cluster gets all tracks.

    Args:
        function: copied to every process, so it must pickle.  tracks: a stream; it is never held as a whole.
        count: approximate number of tracks.  jobs: processes; 1 stays in this one.
    """
    return map_blocks(partial(each, function), tracks, count, jobs, None)


def map_blocks(
    function: Callable[[Sequence[Track]], Iterable[R]],
    tracks: Iterable[Track],
    count: int,
    jobs: int,
    block: int | None,
) -> Iterator[R]:
    """`map_tracks` for a function of `block` tracks, fewer at the end, whose results may depend on the grouping.

    The number of processes does not change the blocks. Without a number the function takes any number of tracks.
    """
    stream, others = iter(tracks), executor(jobs)
    here = partial(with_jobs, jobs, partial(on_one_thread, function))
    if isinstance(others, Processes) and not others.started:
        for first in _chunks(islice(stream, 1), 1) if block is None else ():
            yield from here(first)  # it warms up, and does not count
        here, before = partial(_timed, here), _spent
        probed = list(islice(stream, block or PROBED))
        yield from here(probed) if probed else ()
        coming = (_spent - before) * (count / max(len(probed), 1) - 1.0)
        others = others if _spent + coming > START_UP else None
    if others is None:
        for chunk in _chunks(stream, block or 1):
            yield from here(chunk)
        return
    size = block or max(1, min(others.batch, -(-count // (4 * (others.slots + others.helped)))))
    yield from in_order(function, _chunks(stream, size), others)


def _timed(here: Callable[[Sequence[Track]], Iterable[R]], chunk: Sequence[Track]) -> Iterable[R]:
    """The results of a chunk in this process, whose time counts as spent."""
    global _spent
    start = time.perf_counter()
    found = list(here(chunk))
    _spent += time.perf_counter() - start
    return found


def _chunks(stream: Iterator[T], size: int) -> Iterator[list[T]]:
    while chunk := list(islice(stream, size)):
        yield chunk


def do_all(tasks: Sequence[Callable[[], R]], jobs: int) -> list[R]:
    """The results of tasks that take seconds each, in their order; with less than two jobs or tasks in this process."""
    others = executor(jobs)
    if others is None or len(tasks) < 2:
        return [task() for task in tasks]
    if others.helped:
        return list(in_order(partial(each, operator.call), _chunks(iter(tasks), 1), others))
    return [result for _, result in sorted(finished(operator.call, tasks, others), key=lambda pair: pair[0])]
