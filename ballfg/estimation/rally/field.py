"""Holds all candidates of a recording as a fixed camera sees them, and how likely each is a ball or clutter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.vision.detection.detections import Detections

SEEN, UNKNOWN = 0.9, 0.5
"""Probability that the ball is among the candidates of a picture, at first: among those of `ballfg.vision.broadcast`,
and among those of a detector of which nothing is known."""
SEEN_RANGE: Final = (0.2, 0.95)
"""Of that probability, as a found rally shows it."""
BAR_SIGMA, BAR_SHARE = 1.5, 0.12
"""px, and share of its length, by which a ball's bar differs from its motion while the shutter is open."""
RING: Final = 3.0
"""px, width of the rings in which bars of all candidates are counted."""
STRAY: Final = 0.1
"""Share of a ball's bars that are not: a bounce or a shirt within the exposure."""
ASKEW: Final = 0.5
"""rad between a bar and the motion of its centre."""
LONG: Final = 8.0
"""px of a bar and of a motion whose directions are compared."""


@dataclass(frozen=True, eq=False)
class Field:
    """The candidates of a recording as one fixed camera would see them, sorted by picture.

    Attributes:
        frame: (n,) numbers of their pictures.  pixels: (n, 2).  covariances: (n, 2, 2) px^2.
        bars: (n, 2) px from end to end, zero where not blurred.
        density: (n,) 1/px^2, of clutter that looks as much like a ball.
        usual: (n,) 1/px^2, density of a bar like each one's among all candidates.
        first: (f + 1,) where each picture's begin.  stamps: (f,) s, of the pictures.  step: s between them, the median.
        scale: px for a m at the court.  exposure: of the step, during which the shutter is open.
        seen: probability that the ball is among the candidates of a picture.
    """

    frame: Index
    pixels: Array
    covariances: Array
    bars: Array
    density: Array
    usual: Array
    first: Index
    stamps: Array
    step: float
    scale: float
    exposure: float = 0.0
    seen: float = SEEN

    @classmethod
    def of(cls, seen: Detections, scale: float, ball: float = SEEN) -> Field:
        """The field of detections of a fixed camera that hold the ball with a probability `ball`."""
        count, pixels = len(seen.frames), seen.pixels
        size = pixels.max(axis=0, initial=-np.inf) - pixels.min(axis=0, initial=np.inf)
        better = len(seen) - np.searchsorted(np.sort(seen.scores), seen.scores)
        first = np.searchsorted(seen.frame, np.arange(count + 1))
        step, bars = float(np.median(np.diff(seen.frames))), np.nan_to_num(seen.streaks[:, 1] - seen.streaks[:, 0])
        density = better / count / float(np.prod(np.maximum(size, 1.0)))
        number = (np.linalg.norm(bars, axis=1) // RING).astype(np.int64)
        share = (np.bincount(number) + 1.0) / (len(bars) + number.max(initial=0) + 1.0)
        usual = share[number] / (np.pi * RING**2 * (2.0 * number + 1.0))  # of rings about a bar of no length
        rows = seen.frame, seen.pixels, seen.covariances, bars, density, usual
        return cls(*rows, first, seen.frames, step, scale, seen=ball)

    def smooth(self, density: float) -> Field:
        """The field whose clutter moves smoothly: where its motion foretells a candidate, it has a density, 1/px^2."""
        return replace(self, density=np.maximum(self.density, density))

    def rows(self, frame: int) -> Index:
        """Numbers of the candidates of a picture; none beyond the ends."""
        inside = 0 <= frame < len(self.first) - 1
        return np.arange(self.first[frame], self.first[frame + 1]) if inside else np.zeros(0, dtype=np.int64)

    def along(self, rows: Index, motion: Array) -> Mask:
        """(n,) bool: the bars of rows (n,) lie along motions (n, 2) px, or one of both is short."""
        bars = self.bars[rows]
        cross = np.abs(bars[:, 0] * motion[:, 1] - bars[:, 1] * motion[:, 0])
        long, far = np.linalg.norm(bars, axis=1), np.linalg.norm(motion, axis=1)
        return np.asarray(~((long > LONG) & (far > LONG) & (cross > np.sin(ASKEW) * long * far)))

    def gain(self, rows: Index, motion: Array) -> Array:
        """(k,) logarithm of how much likelier candidates (k, n) are a ball than clutter, by their number and bars.

        Their distances from a path count elsewhere. Args: motion: (k, n, 2) px a picture, of the ball.
        """
        spot = self.density[rows] * 2.0 * np.pi * np.sqrt(np.linalg.det(self.covariances[rows]))
        return np.asarray((self.bar_gain(rows, motion, self.exposure) + np.log(self.seen / spot)).sum(axis=-1))

    def bar_gain(self, rows: Index, motion: Array, exposure: float) -> Array:
        """(..., n) of bars alone: a ball's is as long as its motion while the shutter is open, either way around."""
        if not self.bars.any():  # a detector that gives centres only
            return np.zeros(rows.shape)
        off, variance = self._bar_errors(rows, motion, exposure)
        ratio = np.exp(-0.5 * off / variance) / (2.0 * np.pi * variance) / self.usual[rows]
        return np.asarray(np.log(STRAY + (1.0 - STRAY) * ratio))

    def bar_off(self, rows: Index, motion: Array) -> Array:
        """(n,) standard deviations between bars and motions (n, 2) px a picture."""
        off, variance = self._bar_errors(rows, motion, self.exposure)
        return np.asarray(np.sqrt(off / variance))

    def agree(self, rows: Index, most: float) -> bool:
        """True if all bars of an arc lie within so many standard deviations of its motion."""
        return bool((self.bar_off(rows, self.motion(rows)) < most).all())

    def _bar_errors(self, rows: Index, motion: Array, exposure: float) -> tuple[Array, Array]:
        """(n,) px^2, squared distances of bars from motions while the shutter is open, and their variances."""
        bars, true = self.bars[rows], exposure * motion
        off = np.minimum(((bars - true) ** 2).sum(axis=-1), ((bars + true) ** 2).sum(axis=-1))
        return off, BAR_SIGMA**2 + BAR_SHARE**2 * (true**2).sum(axis=-1)

    def motion(self, rows: Index) -> Array:
        """(n, 2) px a picture, of an arc."""
        return np.asarray(np.gradient(self.pixels[rows], self.frame[rows].astype(np.float64), axis=0))
