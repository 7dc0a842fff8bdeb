"""Parses candidate settings of a launcher, such as `topspin=-3..5,speed=8..14`, to all combinations."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from ballfg.arrays import Array

MOST = 5000  # Largest number of combinations. More take minutes, and neighbours hardly differ


def parse_levels(text: str, what: str = "candidates") -> dict[str, list[float]]:
    """Rising levels by setting, of a text such as `topspin=-3..5,wheel=1200..2000:200,speed=9`.

    Args: what: name of the text in messages.

    Raises: ValueError: a text of another form, a repeated setting, a step that is not positive, or too many
        combinations.
    """
    found: dict[str, list[float]] = {}
    for part in text.split(","):
        name, _, span = part.partition("=")
        name = name.strip()
        if name in found:
            raise ValueError(f"{what} must name each setting once; got '{name}' twice. Remove one.")
        found[name] = _levels(name, span, part.strip(), what)
    count = math.prod(len(levels) for levels in found.values())
    if count > MOST:
        raise ValueError(
            f"{what} must be at most {MOST} combinations; got {count}. Use larger steps: NAME=FROM..TO:STEP."
        )
    return found


def _levels(name: str, span: str, part: str, what: str) -> list[float]:
    ends, _, width = span.partition(":")
    low, dots, high = ends.partition("..")
    try:
        first, last, step = float(low), float(high if dots else low), float(width) if width else 1.0
    except ValueError:
        first = last = step = math.nan
    if not name or not (math.isfinite(first) and math.isfinite(last) and first <= last and 0.0 < step < math.inf):
        raise ValueError(
            f"{what} must read NAME=LEVEL, NAME=FROM..TO or NAME=FROM..TO:STEP, separated by commas; got '{part}'. "
            "Write for instance topspin=-3..5,sidespin=-5..5,speed=8..14 or x=-4..4:2."
        )
    if (last - first) / step >= MOST:
        raise ValueError(f"{what} must be at most {MOST} combinations; {name} alone has more. Use a larger step.")
    return [first + step * k for k in range(math.floor((last - first) / step + 1e-9) + 1)]


def combinations(levels: Mapping[str, Sequence[float]]) -> Array:
    """(m, s) every combination of the levels of s settings, the last setting changing fastest."""
    return np.array(list(itertools.product(*levels.values())), dtype=np.float64)
