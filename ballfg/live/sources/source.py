"""Where samples come from: the interface of all sources, standard input, and the queue in which live lines wait."""

from __future__ import annotations

import os
import queue
import stat
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Protocol

from ballfg.live.sources.lines import LONGEST, LineReader, Sample

WAITING = 1024
"""Samples that may wait. Then a pipe or a TCP sender has to wait too, and of UDP packets the oldest are dropped."""
CHUNK = 65536
"""Bytes read at once."""


@dataclass(frozen=True)
class Arrival:
    """One line of input.

    Attributes:
        read: s, `time.perf_counter` when it was read.
        sample: what it says; None of a line that cannot be used.
        problem: why not.
    """

    read: float
    sample: Sample | None
    problem: str = ""


class Source(Protocol):
    """A stream of samples."""

    name: str
    """For messages."""
    live: bool
    """Whether lines come at their own pace, so that they must be read at once. Other sources wait until asked."""
    lossy: bool
    """Whether the oldest waiting lines are dropped where too many wait; else the sender waits."""

    def arrivals(self, stop: threading.Event) -> Iterator[Arrival]:
        """The lines as they are read, until the source ends or `stop` is set. Raises: OSError: it cannot be read."""
        ...

    def close(self) -> None:
        """Let go of files and sockets."""
        ...


class LineBuffer:
    """Bytes of one sender to lines; a line without end is cut."""

    def __init__(self) -> None:
        self._reader = LineReader()
        self._rest = b""
        self._skips = False
        self._now = perf_counter()

    def feed(self, chunk: bytes) -> Iterator[Arrival]:
        """The lines that a chunk completes, which has just been read."""
        self._now = perf_counter()
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        for line in lines:
            if self._skips:  # the end of a line that was cut
                self._skips = False
                continue
            yield from self._read(line)
        if len(self._rest) > LONGEST:
            if not self._skips:
                yield from self._read(self._rest)
            self._rest, self._skips = b"", True

    def end(self) -> Iterator[Arrival]:
        """The last line, where no line feed ended it."""
        if self._rest and not self._skips:
            yield from self._read(self._rest)
        self._rest, self._skips = b"", False

    def _read(self, line: bytes) -> Iterator[Arrival]:
        now = self._now
        try:
            sample = self._reader.read(line)
        except ValueError as error:
            yield Arrival(now, None, f"{error}: {line[:60].decode('utf-8', errors='replace')!r}")
            return
        if sample is not None:
            yield Arrival(now, sample)


class Pipe:
    """Standard input: a pipe or terminal is live, a file is read as it is needed."""

    name = "standard input"
    lossy = False

    def __init__(self, handle: int | None = None) -> None:
        self._handle = sys.stdin.fileno() if handle is None else handle
        self.live = not stat.S_ISREG(os.fstat(self._handle).st_mode)

    def arrivals(self, stop: threading.Event) -> Iterator[Arrival]:
        """As `Source.arrivals`."""
        buffer = LineBuffer()
        while not stop.is_set() and (chunk := os.read(self._handle, CHUNK)):
            yield from buffer.feed(chunk)
        yield from buffer.end()

    def close(self) -> None:
        """Standard input stays open."""


class Inbox:
    """The samples of a source, those of one stamp together as far as they are there.

    A live source is read by a thread of its own, so that the moment of reading is told truly. A source that waits is
    read when a sample is wanted; that is the moment which counts.

    Attributes: dropped: lines of a lossy source that waited too long.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.dropped = 0
        self._stop = threading.Event()
        self._queue: queue.SimpleQueue[Arrival | BaseException | None] = queue.SimpleQueue()
        self._free = threading.BoundedSemaphore(WAITING)
        self._ahead: Arrival | None = None
        self._ended = False
        self._pulled = None if source.live else source.arrivals(self._stop)
        if source.live:
            threading.Thread(target=self._fill, name="ballfg live input", daemon=True).start()

    def groups(self) -> Iterator[list[Arrival]]:
        """Arrivals of one stamp at a time, in the order in which they came. Raises: OSError: from the source."""
        while (first := self._next(wait=True)) is not None:
            group = [first if self.source.live else replace(first, read=perf_counter())]
            while first.sample is not None and (other := self._next(wait=not self.source.live)) is not None:
                if other.sample is None or other.sample.time != first.sample.time:
                    self._ahead = other
                    break
                group.append(other)
            yield group

    @property
    def waiting(self) -> bool:
        """Whether something newer of a live source waits."""
        return self.source.live and (self._ahead is not None or not self._queue.empty())

    def interrupt(self) -> None:
        """End the samples as if the source had ended; a signal handler may call it."""
        self._stop.set()
        self._ended = True
        self._queue.put(None)

    def close(self) -> None:
        """Stop reading."""
        self._stop.set()
        self.source.close()

    def _next(self, wait: bool) -> Arrival | None:
        """The next arrival; None at the end, or where none is there and nobody waits."""
        if self._ahead is not None and not self._stop.is_set():
            found, self._ahead = self._ahead, None
            return found
        if self._ended:
            return None
        if self._pulled is not None:
            return next(self._pulled, None)
        try:
            arrival = self._queue.get(block=wait)
        except queue.Empty:
            return None
        if isinstance(arrival, BaseException):
            raise arrival
        if arrival is None:
            self._ended = True
        else:
            self._free.release()
        return arrival

    def _fill(self) -> None:
        """The reading thread."""
        end: BaseException | None = None
        try:
            for arrival in self.source.arrivals(self._stop):
                if not self.source.lossy:
                    self._free.acquire()
                elif not self._free.acquire(blocking=False):
                    self._drop_oldest()
                self._queue.put(arrival)
        except Exception as error:
            end = None if self._stop.is_set() else error
        self._queue.put(end)

    def _drop_oldest(self) -> None:
        """Make room for one arrival, unless the room has just been made."""
        try:
            self._queue.get_nowait()
            self.dropped += 1
        except queue.Empty:
            self._free.acquire()
