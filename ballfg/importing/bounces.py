"""Finds the height of the table from the bounces of the balls."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array

_ARM: Final = 0.06  # s of flight for the fit on each side of a bounce
_LEAST_SAMPLES: Final = 3
_LEAST_SPEED: Final = 0.7
"""m/s, least speed of the fall before and of the rise after a bounce; slower ones are rolling balls and noise."""
_MOST_RESIDUAL: Final = 0.02  # m, root mean square about the two flights; more means a hit, an outlier, or two balls
_SAME: Final = 0.04  # m: bounces within this distance of each other are on one surface
_SHARE: Final = 0.3  # of the most frequent surface's bounces that make a higher one the table: balls bounce on below it
_GRAVITY: Final = 10.0  # m/s^2, of the fitted arcs: gravity and a little topspin. An error of 5 moves a bounce by 2 mm.


@dataclass(frozen=True)
class Surface:
    """A height at which balls bounce."""

    centre: float  # m, of the ball's centre at contact, the median of the bounces
    spread: float  # m, standard deviation of one bounce
    bounces: int
    others: tuple[float, ...] = ()  # m, centres at further surfaces


def surface(shots: Iterable[tuple[Array, Array]]) -> Surface | None:
    """The surface of most bounces, or a higher one with nearly as many; of times (n,) s and positions (n, 3) m."""
    heights = np.sort([height for t, p in shots for height in bounce_heights(t, p[:, 2])])
    groups: list[Array] = []
    while len(heights):
        near = np.searchsorted(heights, heights + _SAME, side="right") - np.searchsorted(heights, heights - _SAME)
        apart = np.abs(heights - heights[int(np.argmax(near))])
        groups.append(heights[apart <= _SAME])
        heights = heights[apart > 2.0 * _SAME]
    if not groups:
        return None
    often = [group for group in groups if len(group) >= max(_SHARE * len(groups[0]), 1.0)]
    table = max(often, key=lambda group: float(np.median(group)))
    spread = 1.4826 * float(np.median(np.abs(table - np.median(table))))
    others = tuple(float(np.median(group)) for group in often if group is not table)
    return Surface(float(np.median(table)), spread, len(table), others)


def bounce_heights(times: Array, heights: Array) -> list[float]:
    """Heights (m) of a ball's bounces, where arcs before and after meet; of times (n,) s and heights (n,) m."""
    found: list[tuple[float, float, float]] = []
    for i in range(1, len(times) - 2):
        # the bounce lies between samples i and i + 1, or one of them is the lowest of its neighbours
        if min(heights[i], heights[i + 1]) > min(heights[i - 1], heights[i + 2]):
            continue
        first = min(int(np.searchsorted(times, times[i] - _ARM)), max(i - _LEAST_SAMPLES + 1, 0))
        last = int(np.searchsorted(times, times[i + 1] + _ARM, side="right"))
        last = max(last, min(i + 1 + _LEAST_SAMPLES, len(times)))
        if i + 1 - first < _LEAST_SAMPLES or last - i - 1 < _LEAST_SAMPLES:
            continue
        arms = (slice(first, i + 1), slice(i + 1, last))  # the flight before, up to i, and after
        before, after = (_arc(times[part], heights[part], times[i]) for part in arms)
        if before[1] > -_LEAST_SPEED or after[1] < _LEAST_SPEED or max(before[2], after[2]) > _MOST_RESIDUAL:
            continue
        when = (before[0] - after[0]) / (after[1] - before[1])
        step = times[i + 1] - times[i]
        if -0.1 * step <= when <= 1.1 * step:
            height = before[0] + before[1] * when - 0.5 * _GRAVITY * when**2
            found.append((before[2] + after[2], times[i] + when, height))
    kept: list[tuple[float, float, float]] = []
    for bounce in sorted(found):  # the best-fitting of bounces less than the length of an arm apart
        if all(abs(bounce[1] - other[1]) > _ARM for other in kept):
            kept.append(bounce)
    return [height for _, _, height in kept]


def _arc(times: Array, heights: Array, origin: float) -> tuple[float, float, float]:
    """Height and vertical speed at the origin of a free fall through the samples, and its residual (m)."""
    s = times - origin
    lifted = heights + 0.5 * _GRAVITY * s**2
    design = np.stack([np.ones_like(s), s], axis=1)
    (height, speed), *_ = np.linalg.lstsq(design, lifted, rcond=None)
    residual = lifted - design @ (height, speed)
    return float(height), float(speed), float(np.sqrt(np.mean(residual**2)))
