"""Runs a session of `ballfg live`: samples go from an inbox to a tracker, answers to the output."""

import gc
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np

from ballfg.estimation.online.warm_up import warmed_up
from ballfg.live.gate import assign
from ballfg.live.outlook import Outlook, Plane, answer, encoded, look_out, refusal
from ballfg.live.sources.source import Arrival, Inbox
from ballfg.live.tracker import BallUpdate, Tracker
from ballfg.progress import counted

SHORTEST = 1e-3  # ms, the end of the first bin
STEPS = 200  # Bins per factor of ten: a percentile is right to 1.2 %
DECADES = 9  # Number of factors of ten, from a microsecond to a thousand seconds


class Latencies:
    """A histogram of latencies. Attributes: count: number of latencies. worst: ms."""

    def __init__(self) -> None:
        self.count = 0
        self.worst = 0.0
        self._bins = np.zeros(STEPS * DECADES + 1, dtype=np.int64)

    def add(self, milliseconds: float) -> None:
        """Counts one latency."""
        place = math.ceil(STEPS * math.log10(max(milliseconds, SHORTEST) / SHORTEST))
        self._bins[min(place, len(self._bins) - 1)] += 1
        self.count += 1
        self.worst = max(self.worst, milliseconds)

    def percentile(self, share: float) -> float:
        """ms, latency that a share of all, from 0 to 1, does not exceed; NaN without any."""
        if self.count == 0:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self._bins), max(math.ceil(share * self.count), 1)))
        return min(SHORTEST * 10.0 ** (place / STEPS), self.worst)

    def __str__(self) -> str:
        if self.count == 0:
            return "no line was answered with a state"
        middle, p99, p999 = (self.percentile(share) for share in (0.5, 0.99, 0.999))
        return (
            f"latency of {counted(self.count, 'line')}: median {middle:.2f} ms, 99 % {p99:.2f} ms, "
            f"99.9 % {p999:.2f} ms, worst {self.worst:.2f} ms"
        )


class Watcher(Protocol):
    """A receiver of every update with its outlook: a viewer, a bag."""

    def see(self, update: BallUpdate, outlook: Outlook | None) -> None:
        """Takes note of one update."""
        ...


@dataclass(frozen=True)
class Wanted:
    """The predictions for every state."""

    horizon: float = 1.0  # s, range of the search for events
    plane: Plane | None = None  # whose crossing is predicted; None without one
    patience: float = 0.1
    """s. A live line that waited longer gets no prediction if another one waits, so that states catch up."""


class Session:
    """Answers samples until they end.

    Args: write: writes the bytes of one line at once.  watchers: get every update after its line.

    Attributes:
        latencies: of the lines with states, from reading the input to writing the line.
        malformed: number of unreadable lines.  behind: number of states without prediction because their line waited.
    """

    def __init__(
        self,
        tracker: Tracker,
        inbox: Inbox,
        write: Callable[[bytes], None],
        wanted: Wanted,
        watchers: Sequence[Watcher] = (),
    ) -> None:
        self.tracker = tracker
        self.inbox = inbox
        self.wanted = wanted
        self.latencies = Latencies()
        self.malformed = 0
        self.behind = 0
        self._write = write
        self._watchers = watchers

    def run(self) -> None:
        """Answers samples until the inbox ends. Raises: OSError: from reading or writing."""
        for group in self.inbox.groups():
            self._take(group)
            self.tracker.tidy()
        now = perf_counter()
        for update in self.tracker.end():
            self._tell(update, now)

    def _take(self, group: Sequence[Arrival]) -> None:
        if group[0].sample is None:
            self.malformed += 1
            self._write(encoded(refusal(group[0].problem), 1e3 * (perf_counter() - group[0].read)))
            return
        stated = [arrival.sample is not None and arrival.sample.sigmas is not None for arrival in group]
        for part in [group] if len(set(stated)) == 1 else [[arrival] for arrival in group]:
            self._push(part)

    def _push(self, group: Sequence[Arrival]) -> None:
        samples = [arrival.sample for arrival in group if arrival.sample is not None]
        positions = [position for sample in samples for position in sample.positions]
        sigmas = [sigma for sample in samples for sigma in sample.sigmas or ()]
        owners = [arrival for arrival in group for _ in (arrival.sample.positions if arrival.sample else ())]
        updates = self.tracker.push(samples[0].time, positions, sigmas or None)
        gone = len(updates) - len(owners)
        for update in updates[:gone]:
            self._tell(update, group[0].read)
        for update, arrival in zip(updates[gone:], owners, strict=True):
            self._tell(update, arrival.read, arrival)

    def _tell(self, update: BallUpdate, read: float, arrival: Arrival | None = None) -> None:
        outlook = None
        if update.kind == "state" and update.state is not None:
            waited = perf_counter() - read
            if self.inbox.waiting and waited > self.wanted.patience:
                self.behind += 1
                outlook = Outlook(note=f"no prediction: the line had waited {1e3 * waited:.0f} ms")
            else:
                outlook = look_out(update.state, self.wanted.horizon, self.wanted.plane)
        tag = arrival.sample.tag if arrival is not None and arrival.sample is not None else ()
        fields = answer(update, outlook, tag)
        self._write(encoded(fields, 1e3 * (perf_counter() - read)))
        if outlook is not None:
            self.latencies.add(1e3 * (perf_counter() - read))
        for watcher in self._watchers:
            watcher.see(update, outlook)

    def summary(self) -> Iterator[str]:
        """The summary at the end, one sentence per line."""
        counts = self.tracker.counts
        yield str(self.latencies)
        yield (
            f"{counted(counts.positions, 'position')}, {counted(counts.balls, 'ball')}; {counts.late} late, "
            f"{counts.old} too old, {counts.repeated} repeated, {counts.malformed + self.malformed} malformed, "
            f"{self.inbox.dropped + self.inbox.source.lost} dropped"
        )
        rare = {
            "stamps astray": counts.stray,
            "clocks begun anew": counts.restarts,
            "samples that the estimator could make nothing of": counts.failed,
            "states without prediction, because their lines had waited": self.behind,
        }
        if any(rare.values()):
            yield ", ".join(f"{number} {text}" for text, number in rare.items() if number)


def warm_up(tracker: Tracker, wanted: Wanted) -> None:
    """Estimates and predicts a made-up ball through a bounce, so that a real one waits for no compiler.

    The tracker itself is not changed.
    """
    for state in warmed_up(tracker.estimator):
        update = BallUpdate("state", state.time, 1, state.position, state)
        encoded(answer(update, look_out(state, wanted.horizon, wanted.plane), ()), 0.0)
    assign(np.zeros((2, 2)), 1.0)  # scipy's, which a second ball would wait for
    gc.freeze()  # permanent objects are not scanned again; to look for garbage among them first takes 0.16 s
