"""Classifies the stamps of a stream: late ones, outdated ones, wrong ones, a restart of the sender."""

import math
from collections import deque
from enum import Enum, auto
from statistics import median

RESTART_AFTER = 3  # Number of consecutive rising stamps far behind that mean a restart of the clock
LAST_STEPS = 15  # Number of last steps between stamps whose median is the usual one


class Stamp(Enum):
    """Classes of stamps in a stream."""

    NEW = auto()  # Later than all before it, or equal to the last
    LATE = auto()  # Earlier than the newest, by no more than the lag
    OLD = auto()  # Earlier than that
    BACK = auto()  # The previous stamp was wrong: the stream continues from before it
    RESTART = auto()  # The sender's clock has restarted


class Clock:
    """The newest stamp of a stream, robust against wrong stamps.

    A stamp more than the lag ahead is accepted once the next agrees with it; if that one continues from before, the
    stamp was wrong. Stamps far behind are too old, unless several come in a row: then the sender has restarted.

    Args: lag: s.  gap: s, longest time that a ball may stay unseen.

    Attributes: newest: s.  safe: s, the newest stamp that is not in doubt.  steps: s, the last ones between stamps.
    """

    def __init__(self, lag: float, gap: float) -> None:
        self.lag = lag
        self.gap = gap
        self.newest = -math.inf
        self.safe = -math.inf
        self.steps: deque[float] = deque(maxlen=LAST_STEPS)
        self._behind: deque[float] = deque(maxlen=RESTART_AFTER)

    @property
    def usual_step(self) -> float:
        """s, median of the last steps from one stamp to the next; infinite before there are some."""
        return median(self.steps) if len(self.steps) == LAST_STEPS else math.inf

    def tell(self, time: float) -> Stamp:
        """Classifies a stamp; a new one becomes the clock's time."""
        if self.safe < self.newest:  # the last stamp is in doubt
            if time >= self.newest - self.lag:
                self.safe = self.newest
            elif time >= self.safe - self.lag:
                self.newest = self.safe
                self._advance(time)
                return Stamp.BACK
        if time >= self.newest:
            self._advance(time)
            return Stamp.NEW
        if time >= self.newest - self.lag:
            self._behind.clear()
            return Stamp.LATE
        return self._far_behind(time)

    def _advance(self, time: float) -> None:
        self._behind.clear()
        if time <= self.newest + max(self.lag, self.gap / 5) or self.newest == -math.inf:
            self.safe = max(self.safe, time)
            if 0.0 < time - self.newest < math.inf:
                self.steps.append(time - self.newest)
        self.newest = max(self.newest, time)

    def _far_behind(self, time: float) -> Stamp:
        """A stamp that is too old, or the third of a restarted clock."""
        if self._behind and not 0.0 < time - self._behind[-1] <= self.gap:
            self._behind.clear()
        self._behind.append(time)
        if len(self._behind) < RESTART_AFTER or self.newest - time <= self.gap:
            return Stamp.OLD
        self._behind.clear()
        self.newest = self.safe = time
        return Stamp.RESTART
