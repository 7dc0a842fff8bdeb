"""Rates the hits that may join two strokes, by how near their paths come between them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.estimation.rally.strokes import Grower, Stroke

HIT: Final = 3.0
"""Logarithm of what a hit costs."""
HIT_SIGMA: Final = 0.08
"""m, between the paths before and after a hit: the racket holds the ball for a millisecond; paths bend."""
ROOM: Final = 30.0
"""m^3, in which a stroke begins that no hit joins to another."""
LONGEST_HIT: Final = 0.4
"""s without a candidate about a hit, behind a player."""
HIDDEN: Final = 0.1
"""s, mean of the time for which a player hides the ball about a hit: in broadcasts mostly 1 to 4 pictures at 25 Hz."""
SAME_WAY: Final = 5.0
"""Logarithm of what it costs that the ball goes on along the court after a hit: players alternate."""
MOMENTS: Final = 9
"""Between two strokes, at which their paths are compared."""


@dataclass(frozen=True, eq=False)
class Ahead:
    """Where paths may be hit: places (g, m, 3) m and covariances (g, m, 3, 3) at moments of gaps of 1, 2, ... g."""

    places: Array
    covariances: Array


@dataclass(frozen=True, eq=False)
class Hits:
    """The hits between strokes; remembers the paths about the ends of each stroke."""

    grower: Grower
    ends: dict[tuple[Stroke, int], Ahead] = field(default_factory=dict)

    def between(self, strokes: Sequence[Stroke], later: Sequence[Stroke]) -> Array:
        """(n, m) logarithm of the likelihood that a hit joins a stroke (row) and a later one (column); -inf for none.

        Args: strokes, later: n and m; a stroke that begins before another one ends does not follow it.
        """
        frame = self.grower.field.frame
        first, last = frame[[one.rows[0] for one in later]], frame[[one.rows[-1] for one in strokes]]
        gap = first - last[:, None]
        before, after = np.nonzero((gap > 0) & (gap <= self._widest()))
        found = np.full(gap.shape, -np.inf)
        if not len(before):
            return found
        ways = [np.array([one.path.vectors[0, one.path.bounces + 1, 0] for one in strokes])[before]]
        ways += [np.array([one.path.vectors[0, 1, 0] for one in later])[after]]
        onward = ways[0] * ways[1] > 0.0
        pair = gap[before, after] - 1
        starts, spread = self._all_ahead(strokes, 1, before, pair)
        ends, wider = self._all_ahead(later, -1, after, pair)
        near = _log_normal(ends - starts, spread + wider + HIT_SIGMA**2 * np.eye(3)).max(axis=1)
        seen, step = self.grower.field.seen, self.grower.field.step
        missed = -np.log(1.0 - seen * -np.expm1(-step / HIDDEN)) * pair  # hidden still, or not among the candidates
        found[before, after] = near + np.log(ROOM) - HIT - SAME_WAY * onward - missed
        return found

    def _widest(self) -> int:
        """Pictures between two strokes that a hit joins."""
        return max(1, int(np.ceil(LONGEST_HIT / self.grower.field.step)) - 1)

    def _all_ahead(self, strokes: Sequence[Stroke], way: int, numbers: Index, pair: Index) -> tuple[Array, Array]:
        """Places (k, m, 3) m and covariances (k, m, 3, 3) of the strokes of some numbers (k,), for their gaps."""
        used, place = np.unique(numbers, return_inverse=True)
        every = [self._ahead(strokes[number], way) for number in used.tolist()]
        places, covariances = (np.stack([getattr(one, name) for one in every]) for name in ("places", "covariances"))
        return places[place, pair], covariances[place, pair]

    def _ahead(self, stroke: Stroke, way: int) -> Ahead:
        """The path after (way 1) or before (-1) a stroke, for each gap that a hit may fill, in order of time."""
        if (stroke, way) not in self.ends:
            stamps, count = self.grower.field.stamps, self._widest()
            end = int(self.grower.field.frame[stroke.rows[-1 if way > 0 else 0]])
            other = stamps[np.clip(end + way * np.arange(1, count + 1), 0, len(stamps) - 1)]
            begin = np.full(count, stamps[end])
            earlier, later = (begin, other) if way > 0 else (other, begin)
            moments = np.linspace(earlier, later, MOMENTS, axis=1)
            places, spread = self.grower.places_of(stroke.path, moments.ravel())
            self.ends[stroke, way] = Ahead(places.reshape(count, -1, 3), spread.reshape(count, -1, 3, 3))
        return self.ends[stroke, way]


def _log_normal(off: Array, covariance: Array) -> Array:
    """(...) logarithm of the normal density at distances (..., 3) with covariances (..., 3, 3)."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, off[..., None])[..., 0]
    size = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
    return np.asarray(-0.5 * (white**2).sum(axis=-1) - size - 1.5 * np.log(2.0 * np.pi))
