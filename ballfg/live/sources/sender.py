"""Reads lines as samples, CSV `t,x,y,z` or JSON: bytes become lines, lines wait, those of one stamp become samples."""

import json
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

from ballfg.files.json_file import parse_json

LONGEST = 65536  # Largest number of bytes of a line; the rest of a longer one is skipped
MOST_POSITIONS = 64
"""Largest number of positions of one stamp: more than the tracker follows. Thousands would delay everybody."""
COLUMNS = ("t", "x", "y", "z")
SIGMAS = ("sigma_x", "sigma_y", "sigma_z")


@dataclass(frozen=True)
class Sample:
    """The content of one line: the positions of one stamp."""

    time: float  # s
    positions: list[list[float]]  # of each ball x, y, z in m
    sigmas: list[list[float]] | None = None  # as many standard deviations, m; None without them
    tag: tuple[tuple[str, Any], ...] = ()  # further fields of the answer, such as the trajectory of a replay


class LineReader:
    """Reads the lines of one sender; a header names the columns of the CSV lines that follow."""

    def __init__(self) -> None:
        self._order: list[int] | None = None
        self._sigma_order: list[int] | None = None
        self._width = 0

    def read(self, line: bytes) -> Sample | None:
        """The sample of a line; None for a header, a comment or an empty line. Raises: ValueError: any other line."""
        if len(line) > LONGEST:
            raise ValueError(f"a line must have at most {LONGEST} bytes; got more. Send one sample a line.")
        text = line.decode("utf-8", errors="replace").strip().removeprefix("\ufeff")
        if not text or text.startswith("#"):
            return None
        if text[0] in "{[":
            return _of_json(text)
        cells = [cell.strip() for cell in text.split(",")]
        if all(name in cells for name in COLUMNS):
            self._order = [cells.index(name) for name in COLUMNS]
            self._sigma_order = [cells.index(name) for name in SIGMAS] if all(s in cells for s in SIGMAS) else None
            self._width = len(cells)
            return None
        return self._of_cells(cells)

    def _of_cells(self, cells: list[str]) -> Sample:
        if self._order is None:
            if len(cells) not in (4, 7):
                raise ValueError(
                    f"a CSV line must be t,x,y,z or t,x,y,z,sigma_x,sigma_y,sigma_z; got {len(cells)} cells"
                )
            numbers = _numbers(cells)
            return Sample(numbers[0], [numbers[1:4]], [numbers[4:]] if len(numbers) == 7 else None)
        if len(cells) != self._width:
            raise ValueError(f"a line must have the {self._width} cells of its header; got {len(cells)}")
        t, *position = _numbers([cells[i] for i in self._order])
        own = None if self._sigma_order is None else [_numbers([cells[i] for i in self._sigma_order])]
        return Sample(t, [position], own)


def _numbers(cells: Sequence[Any]) -> list[float]:
    found = []
    for cell in cells:
        try:
            if isinstance(cell, bool):
                raise TypeError
            found.append(float(cell))
        except (TypeError, ValueError):
            raise ValueError(f"a number was expected; got {str(cell)[:40]!r}") from None
    return found


def _of_json(text: str) -> Sample:
    """An object with t and x, y, z, or position, or positions; or the array [t, x, y, z]."""
    try:
        content = parse_json(text)
    except ValueError as error:
        raise ValueError(f"not valid JSON: {error}") from None
    if isinstance(content, list):
        content = dict(zip(COLUMNS, content, strict=False)) if len(content) == 4 else {}
    if not isinstance(content, dict) or "t" not in content:
        raise ValueError("a JSON line must be an object with t and x, y, z, or the array [t, x, y, z]")
    if "positions" in content:
        given = content["positions"]
    elif "position" in content:
        given = [content["position"]]
    elif missing := [axis for axis in COLUMNS[1:] if axis not in content]:
        raise ValueError(f"a JSON line must have x, y and z, or position, or positions; it lacks {', '.join(missing)}")
    else:
        given = [[content[axis] for axis in COLUMNS[1:]]]
    positions = _triples("positions", given)
    if not positions:
        raise ValueError("positions must hold at least one; got none")
    if len(positions) > MOST_POSITIONS:
        raise ValueError(f"positions must be at most {MOST_POSITIONS}; got {len(positions)}")
    (time,) = _numbers([content["t"]])
    return Sample(time, positions, _spreads(content.get("sigma"), len(positions)))


def _spreads(given: Any, count: int) -> list[list[float]] | None:
    """Standard deviations: one number for all, three for all, or three for each position."""
    if given is None:
        return None
    if not isinstance(given, list):
        return [_numbers([given] * 3)] * count
    if not any(isinstance(row, list) for row in given):
        return _triples("sigma", [given]) * count
    spreads = _triples("sigma", given)
    if len(spreads) != count:
        raise ValueError(f"sigma must be one for each of {count} positions; got {len(spreads)}")
    return spreads


def _triples(name: str, given: Any) -> list[list[float]]:
    if not isinstance(given, list) or not all(isinstance(row, list) and len(row) == 3 for row in given):
        raise ValueError(f"{name} must be lists of three numbers; got {json.dumps(given)[:60]}")
    return [_numbers(row) for row in given]


WAITING = 1024  # Largest number of waiting lines in all, shared by the senders with waiting lines
PAUSE = 0.005  # s between two checks whether a full sender may continue


@dataclass(frozen=True)
class Arrival:
    """One line of input."""

    read: float  # s, `time.perf_counter` when it was read
    sample: Sample | None  # its content; None for an unusable line
    problem: str = ""  # reason for an unusable line


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

    def cut(self, chunk: bytes, *, last: bool = False) -> "Iterator[Line]":
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
