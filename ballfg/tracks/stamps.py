"""Converts stamps to the time since a first one, so that results do not depend on a clock's origin."""

import math

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array

TICKS = 1e6  # 1/s. Files usually state stamps in whole microseconds.
SUMMED = 1e-12  # s. Tolerance for sums of whole microseconds.
STAMP_TOLERANCE = 1.5e-6
"""s. A stamp this little after the end of an interval belongs to it: stamps are rounded to a microsecond, or to doubles
0.24 us apart, and their differences by up to one."""


def elapsed(times: ArrayLike, origin: float) -> Array:
    """Time since an origin on the same clock.

    Seconds since 1970 are doubles 0.24 us apart, so that differences of whole microseconds are inexact. If all stamps
    are the doubles of whole microseconds, those are subtracted.

    Args: times: (...) s.  origin: s.
    Returns: (...) s; for stamps of whole microseconds the same bits for any origin of the clock.
    """
    stamps = np.asarray(times, dtype=np.float64)
    ticks, first = np.rint(stamps * TICKS), np.rint(origin * TICKS)
    if (ticks / TICKS == stamps).all() and first / TICKS == origin:
        return np.asarray((ticks - first) / TICKS)
    return np.asarray(stamps - origin)


def written(seconds: ArrayLike, origin: float) -> Array:
    """The stamps (...) s on the data's clock for seconds (...) since an origin, as `elapsed` has computed them."""
    since = np.asarray(seconds, dtype=np.float64)
    ticks, first = np.rint(since * TICKS), np.rint(origin * TICKS)
    with np.errstate(invalid="ignore"):  # a stamp that is not finite stays as it is
        whole = (np.abs(ticks / TICKS - since) < SUMMED).all() and first / TICKS == origin
    if whole:
        return np.asarray((first + ticks) / TICKS)
    return np.asarray(origin + since)


class StreamOrigin:
    """The first finite stamp of a stream, from which the time of all others is counted."""

    def __init__(self) -> None:
        self._first: float | None = None

    def elapsed(self, stamp: float) -> float:
        """S since the stream's first stamp, which this one is if none came before it."""
        if self._first is None and math.isfinite(stamp):
            self._first = stamp
        return stamp if self._first is None else float(elapsed(stamp, self._first))

    def written(self, seconds: float) -> float:
        """The stamp, s on the stream's clock, of a moment that is counted from its first stamp."""
        return float(written(seconds, self._first or 0.0))
