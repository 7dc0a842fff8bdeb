"""Computes the parts of one large piece of work wherever the work around it may run."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from itertools import islice
from typing import Final, TypeVar, cast

from ballfg.parallel.executor import executor
from ballfg.parallel.stream import in_order
from ballfg.parallel.work import each

T = TypeVar("T")
R = TypeVar("R")

AHEAD: Final = 4  # Items of a generator that are made ahead
_JOBS: ContextVar[int] = ContextVar("jobs", default=1)


@contextmanager
def using(jobs: int) -> Iterator[None]:
    """Lets the block's work use several processes."""
    token = _JOBS.set(jobs)
    try:
        yield
    finally:
        _JOBS.reset(token)


def jobs_here() -> int:
    """Number of processes that the present work may use."""
    return _JOBS.get()


def with_jobs(jobs: int, function: Callable[[T], R], argument: T) -> R:
    """The result of a function whose parts may use several processes."""
    with using(jobs):
        return function(argument)


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


def in_threads(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """A function of each item of a stream, in order, a few ahead: on as many threads as `with_jobs` has processes.

    For large items and functions that let other threads run meanwhile, such as OpenCV's of pictures, or machine code
    that is compiled `beside_others`.

    Raises: the function's exceptions.
    """
    jobs, pending = _JOBS.get(), deque[Future[R]]()
    if jobs < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(jobs) as threads:
        for item in items:
            pending.append(threads.submit(function, item))
            if len(pending) > 2 * jobs:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def read_ahead(items: Generator[T, None, None]) -> Iterator[T]:
    """The items of a generator, the next few of which another thread makes; for libraries as of `in_threads`."""
    end = object()
    try:
        with ThreadPoolExecutor(1) as thread:
            pending = deque(thread.submit(next, items, end) for _ in range(AHEAD))
            while (item := pending.popleft().result()) is not end:
                pending.append(thread.submit(next, items, end))
                yield cast("T", item)
    finally:
        items.close()
