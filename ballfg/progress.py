"""Shows the progress of long work: a bar on a terminal, plain lines elsewhere, nothing for under two seconds.

`progress` counts items. `doing` names a stage that cannot be counted. While a command runs, `alive` reports every few
seconds the stage and its duration, unless one of them has just printed something. Doubts and notes on data are printed
here too.
"""

import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final, Protocol, TypeVar

T = TypeVar("T")

QUIET: Final = 2.0  # s. Shorter work shows nothing.
LINE_EVERY: Final = 2.5  # s, least time between plain lines
BEAT: Final = 0.2  # s between two checks of the time since the last line
VARIABLE: Final = "BALLFG_QUIET"
"""Environment variable that silences progress, as the option --quiet does; child processes inherit it."""


@dataclass
class _Stage:
    text: str
    since: float


@dataclass
class _Signs:
    """The nested stages, s spent in those that are resumed, the time of the last line, and whether a bar is shown."""

    stages: list[_Stage] = field(default_factory=list)
    spent: dict[str, float] = field(default_factory=dict)
    said: float = 0.0
    covered: int = 0


_SIGNS: Final = _Signs()


class Watch(Protocol):
    """Passes items through and may report their progress: `progress` is one."""

    def __call__(self, items: Iterable[T], total: int, what: str, /) -> Iterator[T]:
        """The same items. `total` is their exact or approximate number; `what` names them, as `tracks estimated`."""
        ...


def unwatched(items: Iterable[T], total: int, what: str, /) -> Iterator[T]:
    """Passes items through and shows nothing."""
    return iter(items)


def is_quiet() -> bool:
    """True if progress is switched off or cannot be shown: programs without a window have no stderr."""
    return bool(os.environ.get(VARIABLE)) or sys.stderr is None


def be_quiet() -> None:
    """Switches progress off, in this process and its children."""
    os.environ[VARIABLE] = "1"


def counted(number: int, noun: str) -> str:
    """A number with its noun, as `1 track` and `2 tracks`."""
    return f"{number} {noun}{'s' * (number != 1)}"


def say(line: str) -> None:
    """Prints a line about the course of the work on stderr, unless progress is switched off."""
    _SIGNS.said = time.monotonic()
    if not is_quiet():
        print(f"{line}\n", end="", file=sys.stderr, flush=True)  # at once: two threads print


def announce(line: str) -> None:
    """Prints a line about a stage that begins; `alive` repeats it until the next stage."""
    if _SIGNS.stages:
        _SIGNS.stages[-1].text, _SIGNS.stages[-1].since = line, time.monotonic()
    say(line)


def print_doubts(doubts: Iterable[str]) -> None:
    """Prints what is not sure about the tracks in one line, before any result: further lines push it out of sight."""
    from ballfg.checks import visible

    if line := "; ".join(visible(doubt) for doubt in doubts):
        print(f"doubt: {line}", flush=True)


def print_notes(notes: Iterable[str]) -> None:
    """Prints notes for the user on stderr."""
    from ballfg.checks import visible

    for note in notes:
        print(f"note: {visible(note)}", file=sys.stderr)


@contextmanager
def doing(what: str, *, resumed: bool = False) -> Iterator[_Stage]:
    """Names a stage of the work, for `alive`; its text may change on the way.

    Args:
        what: for instance `compiling machine code`.
        resumed: True for many short stages of this name, also within each other, whose durations are one.
    """
    if resumed and (under_way := [stage for stage in _SIGNS.stages if stage.text == what]):
        yield under_way[0]
        return
    stage = _Stage(what, time.monotonic() - (_SIGNS.spent.get(what, 0.0) if resumed else 0.0))
    _SIGNS.stages.append(stage)
    try:
        yield stage
    finally:
        _SIGNS.stages.remove(stage)
        if resumed:
            _SIGNS.spent[what] = time.monotonic() - stage.since


@contextmanager
def alive(what: str) -> Iterator[None]:
    """Reports the present stage on stderr whenever nothing was printed for `LINE_EVERY` seconds.

    Args: what: name of the whole work for users.
    """
    ended = threading.Event()
    beating = threading.Thread(target=_beat, args=(ended,), daemon=True)
    _SIGNS.said = time.monotonic()
    if os.environ.get("RANK", "0") == "0":  # of processes that train together only the first prints
        beating.start()
    with doing(what):
        try:
            yield
        finally:
            ended.set()
            if beating.ident is not None:
                beating.join()


@contextmanager
def idle() -> Iterator[None]:
    """Silences `alive` during work that waits for others or reports by itself."""
    _SIGNS.covered += 1
    try:
        yield
    finally:
        _SIGNS.covered -= 1
        _SIGNS.said = time.monotonic()


def _beat(ended: threading.Event) -> None:
    while not ended.wait(BEAT):
        now = time.monotonic()
        stages = tuple(_SIGNS.stages)
        if stages and not _SIGNS.covered and now - _SIGNS.said >= LINE_EVERY - BEAT:
            say(f"{stages[-1].text}: {now - stages[-1].since:.0f} s so far")


def progress(items: Iterable[T], total: int, what: str, /) -> Iterator[T]:
    """Passes items through and shows the progress on stderr.

    Args: items: a stream.  total: their number.  what: for instance `tracks estimated`.
    """
    if is_quiet():
        return iter(items)
    return _bar(items, total, what) if sys.stderr.isatty() else _lines(items, total, what)


def _bar(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    start = time.monotonic()
    with idle(), Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=total, visible=False)
        showing = threading.Timer(QUIET, lambda: bar.update(task, visible=True))
        showing.daemon = True
        showing.start()
        try:
            for item in items:
                yield item
                bar.update(task, advance=1, visible=time.monotonic() - start > QUIET)
        finally:
            showing.cancel()


def _lines(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    due = time.monotonic() + QUIET
    since: tuple[float, int] | None = None
    with doing(what) as stage:
        for done, item in enumerate(items, start=1):
            yield item
            stage.text = f"{done} of {total} {what}"
            now = time.monotonic()
            if now < due or done == total:
                continue
            left = ""
            if since is None:  # this time includes the start of processes: count from here on
                since = now, done
            else:
                left = f", {(now - since[0]) / (done - since[1]) * (total - done):.0f} s left"
            say(f"{stage.text}{left}")
            due = now + LINE_EVERY
