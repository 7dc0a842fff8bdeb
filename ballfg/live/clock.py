"""The clock of a stream: what is late, what is too late, a stamp gone astray, a sender that began anew."""

import math
from collections import deque
from enum import Enum, auto

RESTART_AFTER = 3
"""Stamps in a row that must lie far behind, and rise, before the clock is taken to have begun anew."""


class Stamp(Enum):
    """What a stamp is to its stream."""

    NEW = auto()
    """Later than all before it, or as late as the last."""
    LATE = auto()
    """Earlier than the newest, by no more than the lag."""
    OLD = auto()
    """Earlier than that."""
    BACK = auto()
    """The stamp before it was astray: the stream goes on from before that."""
    RESTART = auto()
    """The sender's clock has begun anew."""


class Clock:
    """The newest stamp of a stream, however wrong some stamps are.

    A stamp more than the lag ahead is believed once the next agrees with it; if that one goes on from before, the stamp
    was astray. Stamps far behind are too old, unless several come in a row: then the sender has begun anew.

    Args: lag: s.  gap: s, longer than a ball stays unseen.

    Attributes:
        newest: s.
        safe: s, the newest stamp that is not in doubt.
    """

    def __init__(self, lag: float, gap: float) -> None:
        self.lag = lag
        self.gap = gap
        self.newest = -math.inf
        self.safe = -math.inf
        self._behind: deque[float] = deque(maxlen=RESTART_AFTER)

    def tell(self, time: float) -> Stamp:
        """What a stamp is; the clock then stands at it if it is new."""
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
        self.newest = max(self.newest, time)

    def _far_behind(self, time: float) -> Stamp:
        """A stamp that is too old, or the third of a clock that has begun anew."""
        if self._behind and not 0.0 < time - self._behind[-1] <= self.gap:
            self._behind.clear()
        self._behind.append(time)
        if len(self._behind) < RESTART_AFTER or self.newest - time <= self.gap:
            return Stamp.OLD
        self._behind.clear()
        self.newest = self.safe = time
        return Stamp.RESTART
