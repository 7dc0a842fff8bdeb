"""Computes the parts of one large piece of work wherever the work around it may run."""

from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from functools import partial
from itertools import islice
from typing import TypeVar

from ballfg.parallel.executor import executor
from ballfg.parallel.stream import in_order
from ballfg.parallel.work import each

T = TypeVar("T")
R = TypeVar("R")

_JOBS: ContextVar[int] = ContextVar("jobs", default=1)


def with_jobs(jobs: int, function: Callable[[T], R], argument: T) -> R:
    """The result of a function whose parts may use several processes."""
    token = _JOBS.set(jobs)
    try:
        return function(argument)
    finally:
        _JOBS.reset(token)


def in_parts(function: Callable[[T], R], parts: Sequence[T], together: int) -> Iterator[R]:
    """A function of each part, in order: in the processes of `with_jobs`, on a cluster, or here.

    Each result depends on its part alone, so that it has the same bits on every process.

    Args: function, parts: copied to processes, so they must pickle.  together: number of parts in one task.
    Raises: the function's exceptions.
    """
    others = executor(_JOBS.get()) if len(parts) > together else None
    if others is None:
        yield from map(function, parts)
        return
    stream = iter(parts)
    chunks = iter(lambda: list(islice(stream, together)), [])
    yield from in_order(partial(each, function), chunks, others)
