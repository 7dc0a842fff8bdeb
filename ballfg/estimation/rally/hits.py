"""Rates the hits that may join two strokes, by how near their paths come between them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import FIVE, FOUR, INDEX, NOTHING, ONE
from ballfg.estimation.observations.bounced_path import places_of
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
class Hits:
    """The hits between strokes.

    It remembers where each stroke may be hit after (1) or before (-1) it: places (g, m, 3) m and covariances
    (g, m, 3, 3) at m moments of gaps of 1, 2, ... g pictures.
    """

    grower: Grower
    ends: dict[tuple[Stroke, int], tuple[Array, Array]] = field(default_factory=dict)

    def between(self, strokes: Sequence[Stroke], later: Sequence[Stroke]) -> Array:
        """(n, m) logarithm of the likelihood that a hit joins a stroke (row) and a later one (column); -inf for none.

        Args: strokes, later: n and m; a stroke that begins before another one ends does not follow it.
        """
        before, after = np.divmod(np.arange(len(strokes) * len(later)), len(later))
        return self.pairs(strokes, later, before, after).reshape(len(strokes), len(later))

    def pairs(self, strokes: Sequence[Stroke], later: Sequence[Stroke], before: Index, after: Index) -> Array:
        """(k,) the same of pairs of a stroke and a later one, by their numbers (k,)."""
        field, found = self.grower.field, np.full(len(before), -np.inf)
        first, last = field.frame[[one.rows[0] for one in later]], field.frame[[one.rows[-1] for one in strokes]]
        gap = first[after] - last[before]
        (near,) = np.nonzero((gap > 0) & (gap <= self._widest()))
        if not len(near):
            return found
        ways = [np.array([one.path.vectors[0, one.path.bounces + 1, 0] for one in strokes])[before[near]]]
        ways += [np.array([one.path.vectors[0, 1, 0] for one in later])[after[near]]]
        onward, pair, density = ways[0] * ways[1] > 0.0, gap[near] - 1, np.empty(len(near))
        ends = self._all_ahead(strokes, 1, before[near]), self._all_ahead(later, -1, after[near])
        (places, spread, one), (others, wider, other) = ends
        _nearest(places, spread, others, wider, np.stack((one, other, pair), axis=1), density)
        missed = -np.log(1.0 - field.seen * -np.expm1(-field.step / HIDDEN)) * pair  # or hidden still
        found[near] = density + np.log(ROOM) - HIT - SAME_WAY * onward - missed
        return found

    def _widest(self) -> int:
        """Pictures between two strokes that a hit joins."""
        return max(1, int(np.ceil(LONGEST_HIT / self.grower.field.step)) - 1)

    def _all_ahead(self, strokes: Sequence[Stroke], way: int, numbers: Index) -> tuple[Array, Array, Index]:
        """Places (u, g, m, 3) m and covariances (u, g, m, 3, 3) of u strokes, and which has each number (k,)."""
        used, which = np.unique(numbers, return_inverse=True)
        every = [self._ahead(strokes[number], way) for number in used.tolist()]
        places, covariances = (np.stack(part) for part in zip(*every, strict=True))
        return places, covariances, which.astype(np.int64)

    def _ahead(self, stroke: Stroke, way: int) -> tuple[Array, Array]:
        """The path after (way 1) or before (-1) a stroke, for each gap that a hit may fill, in order of time."""
        if (stroke, way) not in self.ends:
            stamps, count = self.grower.field.stamps, self._widest()
            end = int(self.grower.field.frame[stroke.rows[-1 if way > 0 else 0]])
            other = stamps[np.clip(end + way * np.arange(1, count + 1), 0, len(stamps) - 1)]
            begin = np.full(count, stamps[end])
            earlier, later = (begin, other) if way > 0 else (other, begin)
            moments = np.linspace(earlier, later, MOMENTS, axis=1)
            places, spread = places_of(self.grower.scene, stroke.path, 0, moments.ravel())
            self.ends[stroke, way] = places.reshape(count, -1, 3), spread.reshape(count, -1, 3, 3)
        return self.ends[stroke, way]


@machine_code(NOTHING(FOUR, FIVE, FOUR, FIVE, INDEX, ONE))
def _nearest(places, spread, others, wider, pairs, density):
    """Writes the largest logarithm (k,) of the normal density of what parts two paths, about a hit.

    Args: places, others: (u, g, m, 3) m.  spread, wider: (u, g, m, 3, 3) m^2.  pairs: (k, 3) numbers of both and gap.
    """
    root, white = np.zeros((3, 3)), np.zeros(3)
    for k in range(len(pairs)):
        one, other, gap = pairs[k]
        density[k] = -np.inf
        for m in range(places.shape[2]):
            value = -1.5 * math.log(2.0 * math.pi)
            for a in range(3):
                for b in range(a + 1):
                    left = spread[one, gap, m, a, b] + wider[other, gap, m, a, b] + (HIT_SIGMA**2 if a == b else 0.0)
                    for c in range(b):
                        left -= root[a, c] * root[b, c]
                    root[a, b] = math.sqrt(left) if a == b else left / root[b, b]
                white[a] = others[other, gap, m, a] - places[one, gap, m, a]
                for c in range(a):
                    white[a] -= root[a, c] * white[c]
                white[a] /= root[a, a]
                value -= 0.5 * white[a] * white[a] + math.log(root[a, a])
            density[k] = max(density[k], value)
