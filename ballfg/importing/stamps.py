"""Reads stamps without loss of precision: whole nanoseconds stay whole until the first stamp is subtracted."""

import re
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.importing.formats.raw import MISSING, Column
from ballfg.tracks.stamps import elapsed

Stamps = NDArray[Any]  # (n,) int64 or float64, in an unknown unit
NO_STAMP: Final = np.iinfo(np.int64).min  # marks a missing stamp among whole numbers
_CLOCK: Final = re.compile(r"^(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)$")
_FINE: Final = re.compile(r"^(.*:\d{2})[.,](\d+)(.*)$")
_DIVISORS: Final = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_LATEST: Final = 1e19  # largest stamp: 300 years in ns
_FAR: Final = 1e6  # s: larger stamps are counted from the first one, so that a float keeps their microseconds


def as_stamps(column: Column) -> Stamps | None:
    """The column as stamps; dates and times of day as whole ns. None if it is no time."""
    if column.dtype.kind in "if":
        return column
    parsed = [_parsed(str(cell)) for cell in column]
    present = sum(one is not None for one in parsed)
    if not present or present + sum(str(cell).lower() in MISSING for cell in column) < len(column):
        return None
    return np.array([NO_STAMP if one is None else one for one in parsed], dtype=np.int64)


def joined(seconds: Column, nanoseconds: Column) -> Stamps:
    """Stamps in ns from their two parts."""
    return seconds.astype(np.int64) * 1_000_000_000 + nanoseconds.astype(np.int64)


def missing(stamps: Stamps) -> NDArray[np.bool_]:
    """(n,) True for missing stamps."""
    return stamps == NO_STAMP if stamps.dtype.kind == "i" else ~(np.abs(stamps) <= _LATEST)


def origin_of(stamps: Stamps, unit: str) -> int | float:
    """The stamp that becomes zero: the first one if they are very large, else their own zero."""
    first = stamps.min().item()
    latest = max(abs(first), abs(stamps.max().item()))
    return first if latest / _DIVISORS[unit] > _FAR else 0


def in_seconds(stamps: Stamps, unit: str, origin: int | float) -> Array:
    """(n,) s since the origin."""
    if stamps.dtype.kind == "f" and unit == "s":
        return elapsed(stamps, origin)
    return np.asarray(stamps - origin, dtype=np.float64) / _DIVISORS[unit]


def _parsed(text: str) -> int | None:
    """Ns of a date (since 1970) or of a time of day (since midnight)."""
    clock = _CLOCK.match(text)
    if clock:
        seconds, _, rest = clock[3].replace(",", ".").partition(".")
        whole = (int(clock[1]) * 60 + int(clock[2])) * 60 + int(seconds)
        return whole * 1_000_000_000 + int(f"{rest:0<9}"[:9])
    fine = _FINE.match(text)
    rest = fine[2] if fine else ""
    try:
        moment = datetime.fromisoformat(f"{fine[1]}{fine[3]}" if fine else text)
    except ValueError:
        return None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return int(moment.timestamp()) * 1_000_000_000 + int(f"{rest:0<9}"[:9])
