"""Determines where the table, its net and the floor are drawn."""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import TABLE_ABOVE_FLOOR, TABLE_LENGTH, TABLE_WIDTH
from ballfg.tracks import TABLE_TENNIS
from ballfg.tracks.info import TENNIS, DatasetInfo

NET_HEIGHT = 0.1525  # m, height above the table, and overhang at its sides (ITTF Laws 2.2)
SMALL_BALL = 0.5 * (TABLE_TENNIS.radius + TENNIS.radius)
"""m. Balls below this radius count as table-tennis balls: their table has the size of the rules, and a net."""
MARGIN = 0.2  # m by which a surface with unknown ends extends beyond the samples


@dataclass(frozen=True)
class Outline:
    """Heights and ends of table and floor."""

    height: float  # m, of the surface
    extent: tuple[float, float, float, float]  # (x_low, x_high, y_low, y_high) m
    net: bool  # True if a net stands across the longer side
    floor: float | None  # m, height of the floor; None if unknown
    words: str  # a sentence on the origin of the ends

    @property
    def surfaces(self) -> tuple[float, ...]:
        """m, heights of table and floor."""
        return (self.height,) if self.floor is None else (self.height, self.floor)


def outline(info: DatasetInfo, positions: Array) -> Outline | None:
    """The table of a dataset; None if it has no surface.

    Args: info: of the dataset.  positions: (n, 3) m, samples above the table, n >= 1.
    """
    if info.table_height is None:
        return None
    low, high = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
    seen = (low[0] - MARGIN, high[0] + MARGIN, low[1] - MARGIN, high[1] + MARGIN)
    small = info.ball.radius < SMALL_BALL
    floor = info.table_height - TABLE_ABOVE_FLOOR if small else None
    if info.table_extent is not None:
        words = "The ends of the table are those of dataset.yaml."
        ends = tuple(e if np.isfinite(e) else other for e, other in zip(info.table_extent, seen, strict=True))
        return Outline(info.table_height, _numbers(ends), small, floor, words)
    if not small:
        words = "dataset.yaml does not state where the surface ends: it is drawn under all samples."
        return Outline(info.table_height, _numbers(seen), False, floor, words)
    middle = 0.5 * (low + high)
    along_x = high[0] - low[0] >= high[1] - low[1]
    half = 0.5 * np.array((TABLE_LENGTH, TABLE_WIDTH) if along_x else (TABLE_WIDTH, TABLE_LENGTH))
    ends = (middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1])
    words = (
        "dataset.yaml does not state where the table's ends are: a table of the rules' size is drawn under the middle "
        "of the samples. Only its height is known."
    )
    return Outline(info.table_height, _numbers(ends), False, floor, words)


def _numbers(ends: tuple[float, ...]) -> tuple[float, float, float, float]:
    a, b, c, d = (float(end) for end in ends)
    return a, b, c, d
