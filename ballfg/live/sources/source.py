"""Defines the interface of all sources, standard input, replays, and the inbox in which live lines wait."""

import os
import stat
import sys
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from time import perf_counter

from ballfg.live.sources.sender import WAITING, Arrival, Line, Sample, Sender
from ballfg.tracks import Dataset
from ballfg.tracks.stamps import written

LEAST = 16  # Least number of lines that each sender may have waiting
CHUNK = 65536  # Number of bytes read at once from standard input, or of a packet


class Source:
    """A stream of lines or samples.

    Attributes:
        name: for messages.  trust: a sentence on who may send to it; empty if only this process's user can.
        live: True if lines come at their own pace, so that they must be read at once. Other sources wait until read.
        repeats: True if the stream starts from its beginning when opened again, as a file does.
        lossy: True if the oldest lines of a full sender are dropped; else the source reads no more of it.
        lost: number of lines or packets that the system dropped unread.
    """

    name = ""
    trust = ""
    live = True
    repeats = False
    lossy = False
    lost = 0

    def lines(self, stop: threading.Event) -> Iterator[Line]:
        """The lines as they are read, until the source ends or `stop` is set. Raises: OSError: it cannot be read."""
        raise NotImplementedError

    def close(self) -> None:
        """Closes sockets; by default there are none."""


class Pipe(Source):
    """Standard input: a pipe or terminal is live, a file is read on demand."""

    name = "standard input"

    def __init__(self, handle: int | None = None) -> None:
        self._handle = sys.stdin.fileno() if handle is None else handle
        self.repeats = stat.S_ISREG(os.fstat(self._handle).st_mode)
        self.live = not self.repeats

    def lines(self, stop: threading.Event) -> Iterator[Line]:
        """As `Source.lines`."""
        sender, chunk = Sender(), b"\n"
        while chunk:
            sender.wait_for_room(stop)
            if stop.is_set():
                return
            chunk = os.read(self._handle, CHUNK)
            yield from sender.cut(chunk, last=not chunk)


class Inbox:
    """The samples of a source, grouped by stamp as far as they have arrived.

    A thread reads a live source, so that the moment of reading is true. Its senders take turns: a busy one delays
    another by the answers to one of its stamps at most. A source that waits is read when a sample is needed; that
    moment counts.

    Attributes: dropped: number of a lossy source's lines that waited too long.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.dropped = 0
        self._stop = threading.Event()
        self._changed = threading.Condition()
        self._turns: deque[Sender] = deque()
        self._ended = False
        self._error: Exception | None = None
        if source.live:
            threading.Thread(target=self._fill, name="ballfg live input", daemon=True).start()

    def groups(self) -> Iterator[list[Arrival]]:
        """Arrivals of one stamp at a time, each sender's in their order. Raises: OSError: from the source."""
        if not self.source.live:
            yield from self._asked()
            return
        while (group := self._turn()) is not None:
            if group:
                yield group
        if self._error is not None:
            raise self._error

    @property
    def waiting(self) -> bool:
        """True if something of a live source waits."""
        return bool(self._turns)

    def interrupt(self) -> None:
        """Ends the samples as if the source had ended; a signal handler may call it."""
        self._stop.set()
        self._end()

    def close(self) -> None:
        """Stops reading."""
        self._stop.set()
        self.source.close()

    def _turn(self) -> list[Arrival] | None:
        """The next sender's waiting arrivals of one stamp; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._turns or self._ended)
            if self._stop.is_set() or not self._turns:
                return None
            sender = self._turns.popleft()
            group = sender.take()
            if sender.busy:
                self._turns.append(sender)
            return group

    def _asked(self) -> Iterator[list[Arrival]]:
        """The same for a source that waits, which has one sender."""
        sender = Sender()
        lines = ((line.read, line.content) for line in self.source.lines(self._stop))
        now = perf_counter()
        while not self._stop.is_set() and (group := sender.take_from(lines)):
            yield [replace(arrival, read=max(arrival.read, now)) for arrival in group]
            now = perf_counter()

    def _fill(self) -> None:
        try:
            for line in self.source.lines(self._stop):
                self._put(line)
        except Exception as error:
            self._error = None if self._stop.is_set() else error
        self._end()

    def _end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _put(self, line: Line) -> None:
        sender = line.sender
        with self._changed:
            if not sender.busy:
                self._turns.append(sender)
            sender.most = max(LEAST, WAITING // len(self._turns))
            while sender.full and self.source.lossy:
                sender.waiting.popleft()
                sender.dropped += 1
                self.dropped += 1
            sender.waiting.append((line.read, line.content))
            self._changed.notify_all()


PAUSE = 1.0  # s between two tracks: longer than a ball may stay unseen


class Replay(Source):
    """Samples at their own pace, or a multiple of it.

    Args: samples: with their stamps, which set the pace.  speed: 1 is real time; 0 is without pauses.
    """

    repeats = True

    def __init__(self, samples: Iterable[Sample], speed: float, name: str) -> None:
        self.samples = samples
        self.speed = speed
        self.live = speed > 0.0
        self.name = name

    def lines(self, stop: threading.Event) -> Iterator[Line]:
        """As `Source.lines`."""
        sender = Sender()
        begun: tuple[float, float] | None = None
        for sample in self.samples:
            sender.wait_for_room(stop)
            if self.live:
                begun = begun or (perf_counter(), sample.time)
                wait = begun[0] + (sample.time - begun[1]) / self.speed - perf_counter()
                if wait > 0.0 and stop.wait(wait):
                    return
            yield Line(sender, perf_counter(), sample)


def dataset_samples(dataset: Dataset) -> Iterator[Sample]:
    """The samples of a dataset on one clock: each track begins `PAUSE` after the end of the previous one.

    Their tags hold the trajectory and the stamp on its own clock.
    """
    origin: float | None = None
    begins = 0.0  # s, from the first track's first sample to this one's
    for track in dataset:
        origin = float(track.times[0]) if origin is None else origin
        moments = zip(track.times.tolist(), track.seconds.tolist(), track.positions.tolist(), strict=True)
        for k, (time, since, position) in enumerate(moments):
            sigmas = None if track.sigmas is None else [track.sigmas[k].tolist()]
            stamp = float(written(begins + since, origin))
            yield Sample(stamp, [position], sigmas, (("trajectory", track.name), ("t_track", time)))
        begins += track.duration + PAUSE
