"""Progress of long work: a bar on a terminal, plain lines now and then elsewhere; nothing for less than two seconds."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")

QUIET = 2.0
"""s. Work that is over before that shows nothing."""
LINE_EVERY = 10.0
"""s between plain lines."""


class Watch(Protocol):
    """Hands items through as they are done, for instance to show how far the work is: `progress` is one."""

    def __call__(self, items: Iterable[T], total: int, what: str, /) -> Iterator[T]:
        """The same items. `total` is their number, an estimate at times; `what` names them, as `tracks estimated`."""
        ...


def unwatched(items: Iterable[T], total: int, what: str, /) -> Iterator[T]:
    """Hands items through and shows nothing."""
    return iter(items)


def progress(items: Iterable[T], total: int, what: str, /) -> Iterator[T]:
    """Hands items through and shows on stderr how far it is.

    Args: items: a stream.  total: how many there will be.  what: for instance `tracks estimated`.
    """
    return _bar(items, total, what) if sys.stderr.isatty() else _lines(items, total, what)


def _bar(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    start = time.monotonic()
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=False) as bar:
        task = bar.add_task(what, total=total, visible=False)
        for item in items:
            yield item
            bar.update(task, advance=1, visible=time.monotonic() - start > QUIET)


def _lines(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    due = time.monotonic() + QUIET
    since: tuple[float, int] | None = None
    for done, item in enumerate(items, start=1):
        yield item
        now = time.monotonic()
        if now < due or done == total:
            continue
        left = ""
        if since is None:  # the time up to here went into the start of processes too: count from here on
            since = now, done
        else:
            left = f", {(now - since[0]) / (done - since[1]) * (total - done):.0f} s left"
        print(f"{done} of {total} {what}{left}", file=sys.stderr, flush=True)
        due = now + LINE_EVERY
