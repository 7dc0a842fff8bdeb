"""A ball of a tracker holds its estimator, and copies of it for late samples; a newcomer may become a ball."""

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.online import Online
from ballfg.estimation.online.scatter import StreamScatter
from ballfg.estimation.online.state import OnlineState
from ballfg.estimation.smoother.motion import FLIGHT, Motion
from ballfg.live.gate import Gate, Known

PARTS = 4
"""Number of copies of the estimator within a lag: a late sample costs the pushes of the lag and of a quarter of it."""
LEAST_APART = 8  # Least number of samples between two copies: a copy costs some 0.7 ms
LOOK_BACK = 24  # Number of last samples in which an event may still be found or moved
SAME_EVENT = 0.03  # s. Two events of a kind that lie closer are the same.


@dataclass(frozen=True, order=True)
class Kept:
    """A sample of a ball.

    Attributes:
        time: s.  position: (3,) m.  sigma: (3,) m, or None.
        by_hit: True if the sample was taken as one after a hit: it was off the ball's path.
    """

    time: float
    position: Array = field(compare=False)
    sigma: Array | None = field(compare=False, default=None)
    by_hit: bool = field(compare=False, default=False)


@dataclass(frozen=True)
class BallEvent:
    """An event of a ball.

    Attributes:
        kind: `bounce`, `hit`, `rest` (the ball came to lie) or `gap` (too long for a link).
        time: s; of a bounce its own, of a hit the middle of its interval, of the others the first sample after it.
        height: m, of the surface; None without one.
    """

    kind: str
    time: float
    height: float | None = None


class Ball:
    """A ball with the samples of the last lag.

    Args: number: its name.  fresh: an estimator without samples, to be copied.  lag: s.
    """

    def __init__(self, number: int, fresh: Online, lag: float) -> None:
        self.number = number
        self.samples = 0
        self.lag = lag
        self.recent: list[Kept] = []
        self.states: deque[OnlineState] = deque()
        self._fresh = fresh
        self._online = fresh.copy()
        self._copies: list[tuple[float, Online]] = [(-np.inf, fresh)]
        self._since_copy = 0
        self._told: deque[tuple[str, float]] = deque(maxlen=64)

    @property
    def last(self) -> float:
        """s, the newest stamp."""
        return self.states[-1].time

    @property
    def scatter(self) -> StreamScatter | None:
        """Of its samples, where it gives their noise."""
        return self._online.scatter

    def accepts(self, time: float) -> bool:
        """True if a sample of that stamp can be inserted in its place."""
        return time > max(self.last - self.lag, self._copies[0][0])

    def at(self, time: float) -> Kept | None:
        """The sample of exactly that stamp."""
        place = bisect_left(self.recent, time, key=lambda kept: kept.time)
        return self.recent[place] if place < len(self.recent) and self.recent[place].time == time else None

    def known(self, time: float) -> Known:
        """The newest state before a stamp; the oldest one in memory if there is none."""
        for state in reversed(self.states):
            if state.time < time:
                return Known.of(state)
        return Known.of(self.states[0])

    def take(self, kept: Kept) -> OnlineState:
        """Takes in a sample, late or not, in place of one with its stamp; returns the newest state.

        Raises: ValueError, RuntimeError: from the estimator, if the samples cannot be explained.
        """
        if not self.states or kept.time > self.last:
            self.tidy()
            return self._push(kept)
        self._rebuild(kept.time, added=kept)
        return self.states[-1]

    def forget_after(self, time: float) -> bool:
        """Drops the samples after a stamp of the last lag; True if any are left. Raises: as `take`."""
        if self.last > time:
            self._rebuild(time, until=time)
        return bool(self.states)

    def tidy(self) -> None:
        """Makes a copy of the estimator if one is due: best while no sample waits."""
        if (
            not self.states
            or self.lag <= 0.0
            or self._since_copy < LEAST_APART
            or self.last - self._copies[-1][0] < self.lag / PARTS
        ):
            return
        self._copies.append((self.last, self._online.copy()))
        self._since_copy = 0
        while len(self._copies) > 1 and self._copies[1][0] <= self.last - self.lag:
            del self._copies[0]
        oldest = self._copies[0][0]
        while self.recent and self.recent[0].time <= oldest:
            del self.recent[0]
        while self.states[0].time < oldest:  # the state of the copy itself stays: gates start from it
            self.states.popleft()

    def _push(self, kept: Kept) -> OnlineState:
        state = self._online.push(kept.time, kept.position, kept.sigma)
        insort(self.recent, kept)
        self.states.append(state)
        self.samples += 1
        self._since_copy += 1
        if self.lag <= 0.0:
            self.recent, self.states = self.recent[-1:], deque([state])
        return state

    def _rebuild(self, since: float, added: Kept | None = None, until: float = np.inf) -> None:
        """Goes back to the last copy before a stamp, and pushes the later samples in order."""
        while self._copies[-1][0] >= since and len(self._copies) > 1:
            self._copies.pop()
        base, online = self._copies[-1]
        again = [k for k in self.recent if base < k.time <= until and (added is None or k.time != added.time)]
        if added is not None:
            insort(again, added)
        self.samples -= sum(k.time > base for k in self.recent)
        self.recent = [k for k in self.recent if k.time <= base]
        self.states = deque(state for state in self.states if state.time <= base)
        self._online, self._since_copy = online.copy(), 0
        for kept in again:
            self.tidy()
            self._push(kept)

    def start_anew(self, kept: Kept) -> OnlineState:
        """Forgets everything but one sample, after a failure of the estimator. Raises: as `take`."""
        self.recent, self.states, self._copies = [], deque(), [(-np.inf, self._fresh)]
        self._online, self._since_copy = self._fresh.copy(), 0
        return self._push(kept)

    def news(self) -> tuple[BallEvent, ...]:
        """New events among the last samples, in the order of time."""
        window = self._online.window
        if window is None:
            return ()
        samples = window.samples[-LOOK_BACK:]
        found: list[BallEvent] = []
        for before, sample in pairwise(samples):
            if sample.motion is not FLIGHT:
                stamps = map(self._online.stamp_of, (before.time, sample.time))
                found += _events(sample.motion, before.motion, *stamps)
        told = self._told
        fresh = [e for e in found if not any(k == e.kind and abs(t - e.time) < SAME_EVENT for k, t in told)]
        self._told.extend((event.kind, event.time) for event in fresh)
        return tuple(fresh)


def _events(motion: Motion, before: Motion, start: float, end: float) -> Sequence[BallEvent]:
    if not motion.linked:
        return [BallEvent("gap", end)]
    found = [BallEvent("bounce", start + t, h) for t, h in zip(motion.times, motion.heights, strict=True)]
    if motion.hit:
        found.append(BallEvent("hit", 0.5 * (start + end)))
    if motion.rest is not None and before.rest is None:
        found.append(BallEvent("rest", end, motion.rest))
    return found


PATIENCE, MISSED = 0.2, 6
"""s, and usual steps of the stamps, after which an unseen newcomer is forgotten. The longer, the more often wrong
positions lie on a path by chance."""
SPEED = 12.0  # m/s per axis, spread of the velocity of a ball with one position
BEND = 12.0  # m/s^2, deviation of a path from a line through two positions


class Newcomer:
    """The first positions of a possible ball."""

    def __init__(self, first: Kept, gate: Gate) -> None:
        self.samples = [first]
        self.gate = gate

    @property
    def last(self) -> float:
        """s, the newest stamp."""
        return self.samples[-1].time

    def has(self, time: float) -> bool:
        """True if it has a sample of that stamp."""
        return any(kept.time == time for kept in self.samples)

    def repeats(self, time: float, position: Array, closest: float) -> bool:
        """True if it has a sample of that stamp within `closest` m of a position (3,) m."""
        there = (kept.position for kept in self.samples if kept.time == time)
        return any(bool(np.linalg.norm(position - place) < closest) for place in there)

    def distances(self, time: float, positions: Array) -> Array:
        """(n,) squared Mahalanobis distances of positions (n, 3) m from its region at a time."""
        if abs(time - self.last) > PATIENCE:
            return np.full(len(positions), np.inf)
        return self.gate.on_path(self._known(), time, positions)

    def _known(self) -> Known:
        """A line through the first and the last sample, at the last."""
        first, last = self.samples[0], self.samples[-1]
        noise, dt = self.gate.noise, last.time - first.time
        mean, covariance = np.zeros(6), np.zeros((6, 6))
        mean[:3], covariance[:3, :3] = last.position, np.diag(noise)
        if dt > 0.0:
            mean[3:] = (last.position - first.position) / dt
            covariance[3:, 3:] = np.diag(2 * noise / dt**2 + (BEND * dt) ** 2)
            covariance[:3, 3:] = covariance[3:, :3] = np.diag(noise / dt)
        else:
            covariance[3:, 3:] = SPEED**2 * np.eye(3)
        return Known(last.time, mean, covariance)
