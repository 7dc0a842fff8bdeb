"""Computes the chunks of a stream by an executor, in order with few in memory, or as they finish."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Final, TypeVar

from ballfg.parallel.executor import Executor, Pending
from ballfg.parallel.work import alone, each

T = TypeVar("T")
R = TypeVar("R")

AHEAD: Final = 3  # largest number of unfinished chunks per worker
HELPED: Final = 8  # Largest number of further chunks that are done but not consumed. Both bound the memory.
LOOK: Final = 0.02  # s between two checks for finished chunks


def in_order(
    function: Callable[[Sequence[T]], Iterable[R]], chunks: Iterator[Sequence[T]], executor: Executor
) -> Iterator[R]:
    """The results of chunks, one after the other, in the order of the stream.

    However slowly results are consumed, no more than `AHEAD` chunks per worker and `HELPED` more are begun; and no
    worker has more than `AHEAD` in its queue. This process does not wait, where it helps, while a chunk is left that no
    worker has begun.

    Args: function: takes a chunk and returns its results.  chunks: a stream.  executor: computes them.
    Raises: the function's exceptions.
    """
    send = executor.sender(function)
    pending: deque[tuple[Pending, Sequence[T]]] = deque()
    try:
        while True:
            # finished chunks behind an earlier one must not keep new ones from the workers
            most, away = AHEAD * executor.slots, sum(not one.done() for one, _ in pending)
            while away < most and len(pending) < most + HELPED and (chunk := next(chunks, None)) is not None:
                pending.append((send(chunk), chunk))
                away += 1
            if not pending:
                return
            if executor.helped and not pending[0][0].done():
                if len(pending) < most + HELPED and (chunk := next(chunks, None)) is not None:
                    pending.append((_here(function, chunk), chunk))
                    continue
                place = next((k for k, (one, _) in enumerate(pending) if one.cancel()), None)
                if place is not None:
                    pending[place] = (_here(function, pending[place][1]), ())
                    continue
            yield from pending.popleft()[0].result()
    except KeyboardInterrupt:
        executor.stop()
        raise
    finally:
        for one, _ in pending:
            one.cancel()


def _here(function: Callable[[Sequence[T]], Iterable[R]], chunk: Sequence[T]) -> Pending:
    """The result of a chunk, computed in this process."""
    done = Future[Iterable[R]]()
    done.set_result(alone(function, chunk))
    return done


def finished(function: Callable[[T], R], items: Sequence[T], executor: Executor) -> Iterator[tuple[int, R]]:
    """The number and the result of each item, as they finish; this process waits. Raises: the function's exceptions."""
    send = executor.sender(partial(each, function))
    pending = {number: send([item]) for number, item in enumerate(items)}
    try:
        while pending:
            for number in [number for number, one in pending.items() if one.done()]:
                (result,) = pending.pop(number).result()
                yield number, result
            time.sleep(LOOK)
    except KeyboardInterrupt:
        executor.stop()
        raise
    finally:
        for one in pending.values():
            one.cancel()
