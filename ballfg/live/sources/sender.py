"""A sender's bytes become lines, its lines wait in a queue, and lines of one stamp become samples."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple

from ballfg.live.sources.lines import LONGEST, MOST_POSITIONS, LineReader, Sample

WAITING = 1024  # Largest number of waiting lines in all, shared by the senders with waiting lines
PAUSE = 0.005  # s between two checks whether a full sender may continue


@dataclass(frozen=True)
class Arrival:
    """One line of input.

    Attributes:
        read: s, `time.perf_counter` when it was read.  sample: its content; None for an unusable line.
        problem: reason for an unusable line.
    """

    read: float
    sample: Sample | None
    problem: str = ""


class LineBuffer:
    """Cuts the bytes of one sender into lines. The rest of a line that is too long is skipped."""

    def __init__(self) -> None:
        self._rest = b""
        self._skips = False

    def feed(self, chunk: bytes) -> list[bytes]:
        """The lines completed by a chunk, without the empty ones."""
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        if lines and self._skips:  # the rest of a line that is too long
            del lines[0]
            self._skips = False
        if len(self._rest) > LONGEST:
            if not self._skips:
                lines.append(self._rest[: LONGEST + 1])
            self._rest, self._skips = b"", True
        return [line for line in lines if line]

    def end(self) -> list[bytes]:
        """The last line, if it has no line feed."""
        lines = [self._rest] if self._rest and not self._skips else []
        self._rest, self._skips = b"", False
        return lines


class Sender:
    """A sender and its waiting lines.

    Attributes:
        waiting: lines, or samples of a replay, with the time at which they were read (s, `time.perf_counter`).
        most: largest present number of waiting lines.  heard: s, `time.perf_counter` at the end of its last line.
        dropped: number of lines dropped for newer ones.
    """

    def __init__(self, name: str = "") -> None:
        self.name = name
        self.waiting: deque[tuple[float, bytes | Sample]] = deque()
        self.most = WAITING
        self.heard = perf_counter()
        self.dropped = 0
        self._buffer = LineBuffer()
        self._reader = LineReader()
        self._next: Arrival | None = None

    @property
    def full(self) -> bool:
        """True if a source should not read more of it now."""
        return len(self.waiting) >= self.most

    @property
    def busy(self) -> bool:
        """True if something of it waits for an answer."""
        return bool(self.waiting) or self._next is not None

    def wait_for_room(self, stop: threading.Event) -> None:
        """Waits while it is full, until `stop` is set."""
        while self.full and not stop.wait(PAUSE):
            pass

    def cut(self, chunk: bytes, *, last: bool = False) -> Iterator[Line]:
        """The lines completed by a chunk that was just read. Args: last: True if nothing continues the chunk."""
        now = perf_counter()
        found = self._buffer.feed(chunk)
        if last:
            found += self._buffer.end()
        if found or b"\n" in chunk:
            self.heard = now
        return (Line(self, now, line) for line in found)

    def take(self) -> list[Arrival]:
        """The oldest waiting arrivals of one stamp; empty if only comments or headers waited."""
        return self.take_from(self.waiting.popleft() for _ in range(len(self.waiting)))

    def take_from(self, lines: Iterable[tuple[float, bytes | Sample]]) -> list[Arrival]:
        """The next arrivals of one stamp from lines. The first arrival of another stamp is kept for the next call."""
        group, self._next = [] if self._next is None else [self._next], None
        for read, line in lines:
            arrival = self._arrival(read, line)
            if arrival is None:
                continue
            if group and not _are_together(group, arrival):
                self._next = arrival
                break
            group.append(arrival)
        return group

    def _arrival(self, read: float, line: bytes | Sample) -> Arrival | None:
        if isinstance(line, Sample):
            return Arrival(read, line)
        try:
            sample = self._reader.read(line)
        except ValueError as error:
            return Arrival(read, None, f"{error}: {line[:60].decode('utf-8', errors='replace')!r}")
        return None if sample is None else Arrival(read, sample)


class Line(NamedTuple):
    """A line, or a sample of a replay, and its time of reading (s, `time.perf_counter`)."""

    sender: Sender
    read: float
    content: bytes | Sample


def _are_together(group: list[Arrival], other: Arrival) -> bool:
    """True if an arrival has the stamp of a group that is small enough not to delay other senders."""
    first = group[0].sample
    if first is None or other.sample is None or first.time != other.sample.time:
        return False
    count = sum(len(arrival.sample.positions) for arrival in group if arrival.sample is not None)
    return count + len(other.sample.positions) <= MOST_POSITIONS
