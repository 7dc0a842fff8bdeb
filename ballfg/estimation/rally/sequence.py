"""Finds the likeliest sequence of strokes, joined at hits, and the probability of each stroke.

The score of a sequence is the logarithm of its probability against clutter alone. Sums over all sequences (forward and
backward, as for a hidden Markov model) give the probabilities. Strokes far apart in time cost the same after each other
whichever they are, so that both take a time that grows with the length of a recording, not with its square.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.estimation.rally.arcs import telling
from ballfg.estimation.rally.hits import Hits
from ballfg.estimation.rally.strokes import Grower, Stroke

BEGINS: Final = 8.0
"""Logarithm of what a stroke costs that no hit joins to the one before."""
MOST_BOUNCES: Final = 2
"""Of a stroke: a service has two."""
SERVED, PAUSE = 20.0, 0.5
"""Logarithm of what a second bounce costs so many s or less after another stroke: a service begins a rally. From behind
a player a hit at the far end may look like a bounce."""
VOLLEY: Final = 5.0
"""Logarithm of what it costs that a ball is hit which did not bounce before: rules forbid it, and of a bounce right
before a hit nothing may be seen."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """The strokes of the best sequence, and whether a hit joins each to the one before.

    Attributes: probabilities: of each stroke and those like it, with as many bounces and most of its candidates.
    """

    strokes: tuple[Stroke, ...]
    probabilities: Array
    joined: tuple[bool, ...]


def shown_to_fall(grower: Grower, stroke: Stroke) -> bool:
    """True if a stroke without a hit is a ball's: it bounces or, where any flight counts, shows how it falls."""
    field = grower.field
    first, last = field.stamps[field.frame[stroke.rows[[0, -1]]]]
    return stroke.path.bounces > 0 or (not field.play and last - first >= telling(field))


@dataclass(frozen=True, eq=False)
class Links:
    """What strokes (n,), in the order of their ends, cost after each other.

    Those before stroke j that end less than `PAUSE` before it begins are strokes far[j] to end[j] - 1: its pairs are
    pair[j] to pair[j + 1] - 1. What ended earlier costs `begins`.
    """

    begins: Array  # (n,) logarithm of what each costs alone
    far: Index
    end: Index
    pair: Index
    alone: Array  # (k,) of pairs without a hit
    met: Array  # (k,) of pairs that a hit joins
    link: Array  # (k,) the likelier of both

    @classmethod
    def of(cls, grower: Grower, hits: Hits, ordered: Sequence[Stroke]) -> "Links":
        """The links of strokes."""
        field = grower.field
        first, last = (field.frame[[one.rows[end] for one in ordered]] for end in (0, -1))
        begins = np.where([shown_to_fall(grower, one) for one in ordered], -BEGINS, -np.inf)  # else it may be anything
        end = np.searchsorted(last, first)
        far = np.minimum(np.searchsorted(field.stamps[last], field.stamps[first] - PAUSE, side="right"), end)
        pair = np.append(0, np.cumsum(end - far))
        after = np.repeat(np.arange(len(ordered)), end - far)
        before = np.arange(pair[-1]) - pair[after] + far[after]
        # without a hit between them a ball in play was there unseen, or a new rally began at once
        unseen = -np.log(1.0 - field.seen) * (first[after] - last[before] - 1)
        alone = begins[after] - np.minimum(unseen, SERVED)
        bounces = np.array([one.path.bounces for one in ordered])
        met = hits.pairs(ordered, ordered, before, after) - VOLLEY * (bounces[before] == 0)
        # a toss before a service is no stroke
        served = SERVED * ((bounces[after] == MOST_BOUNCES) & (bounces[before] > 0))
        return cls(begins, far, end, pair, alone, met, np.maximum(alone, met) - served)

    def near(self, j: int) -> tuple[slice, Array]:
        """The strokes that end soon before stroke j, and what it costs after each."""
        return slice(self.far[j], self.end[j]), self.link[self.pair[j] : self.pair[j + 1]]

    def joined(self, i: int, j: int) -> bool:
        """True if a hit joins stroke j to stroke i."""
        number = self.pair[j] + i - self.far[j]
        return bool(self.far[j] <= i < self.end[j] and self.met[number] > self.alone[number])

    def best(self, score: Array) -> list[int]:
        """The sequence with the largest sum of scores (n,) and links, if it is positive."""
        count, best, before = len(score), score + self.begins, np.full(len(score), -1)
        top = np.full(count + 1, -1)  # number of the best one among the first
        for j in range(count):
            near, cost = self.near(j)
            ways, early = best[near] + cost, int(top[self.far[j]])
            ends = [(0.0, -1), (best[early], early)] if early >= 0 else [(0.0, -1)]
            gain, before[j] = max(ends, key=lambda one: one[0])
            gain += self.begins[j]
            if len(ways) and ways.max() > gain:
                gain, before[j] = ways.max(), self.far[j] + int(np.argmax(ways))
            best[j] = gain + score[j]
            top[j + 1] = j if top[j] < 0 or best[j] > best[top[j]] else top[j]
        chain, at = list[int](), int(top[count])
        while best.max() > 0.0 and at >= 0:
            chain.append(at)
            at = int(before[at])
        return chain[::-1]

    def chances(self, score: Array) -> Array:
        """(n,) probability of each stroke, by the sums over all sequences."""
        count, none = len(score), np.full(len(score) + 1, -np.inf)
        forward, backward, earlier, later = np.empty(count), np.zeros(count), none.copy(), none.copy()
        for j in range(count):
            near, cost = self.near(j)
            alone = self.begins[j] + np.logaddexp(0.0, earlier[self.far[j]])
            forward[j] = score[j] + np.logaddexp.reduce(np.append(forward[near] + cost, alone))
            earlier[j + 1] = np.logaddexp(earlier[j], forward[j])
        after = -np.inf  # of all that begin long after a stroke
        for j in range(count - 1, -1, -1):
            after = np.logaddexp(after, later[j + 1])
            backward[j] = np.logaddexp(backward[j], after)
            near, cost = self.near(j)
            backward[near] = np.logaddexp(backward[near], cost + score[j] + backward[j])
            later[self.far[j]] = np.logaddexp(later[self.far[j]], self.begins[j] + score[j] + backward[j])
        return np.asarray(np.exp(forward + backward - np.logaddexp(earlier[count], 0.0)))


def best_sequence(grower: Grower, hits: Hits, strokes: Sequence[Stroke]) -> Chosen:
    """The likeliest sequence of strokes that follow each other."""
    if not strokes:
        return Chosen((), np.zeros(0), ())
    ordered = sorted(strokes, key=lambda one: int(grower.field.frame[one.rows[-1]]))
    links, score = Links.of(grower, hits, ordered), np.array([one.score for one in ordered])
    chain, likely, sets = links.best(score), links.chances(score), [frozenset(one.rows.tolist()) for one in ordered]
    first, last, bounces = np.array([(*one.rows[[0, -1]], one.path.bounces) for one in ordered]).T

    def alike(i: int) -> list[int]:
        """The strokes with most of the candidates of stroke i, which have most of theirs from it."""
        some = np.flatnonzero((first <= last[i]) & (last >= first[i]) & (bounces == bounces[i])).tolist()
        return [j for j in some if 2 * len(sets[i] & sets[j]) > max(len(sets[i]), len(sets[j]))]

    # no sequence holds two strokes that are like a third one: their probabilities add up
    probabilities = np.array([likely[alike(i)].sum() for i in chain])
    joined = (False, *(links.joined(i, j) for i, j in pairwise(chain)))[: len(chain)]
    return Chosen(tuple(ordered[i] for i in chain), np.minimum(probabilities, 1.0), joined)
