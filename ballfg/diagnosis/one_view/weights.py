"""Weighs sets of effects by the scores of strokes, in a linear model of their means (docs/derivations/diagnosis.md).

The strengths of a set have the priors of every diagnosis, those of declared coefficients the model's, and all others
are where their effects are absent.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Final

import numpy as np
from scipy import special, stats

from ballfg.arrays import Array
from ballfg.diagnosis.evidence.odds import Odds
from ballfg.diagnosis.evidence.prior import WIDTHS, log_odds
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.search.score import Score
from ballfg.estimation.sides.gaussians import log_density

CLIPPED: Final = 3.5
"""Robust standard deviations from the median beyond which a stroke's score counts no more: a stroke of which a wrong
minimum was found must not decide."""
TRIED: Final = WIDTHS[::2]
"""Widths of the prior that are tried, in usual strengths: a linear model of tens of strokes tells no finer ones."""
MOST: Final = 3  # Effects in one set
KEPT: Final = 6  # Sets of each size that are enlarged


def clipped(scores: Array) -> Array:
    """Scores (n, p) that lie no farther from the median of each column than `CLIPPED`."""
    middle = np.median(scores, axis=0)
    reach = CLIPPED * np.median(np.abs(scores - middle), axis=0) / special.ndtri(0.75)
    return np.asarray(np.clip(scores, middle - reach, middle + reach))


@dataclass(frozen=True)
class Set:
    """A set of effects, weighed."""

    names: frozenset[str]  # Of its effects
    evidence: float
    """Logarithm of the density of the mean scores, up to a constant. Laws that lack what scatters from stroke to stroke
    have a wide one."""
    odds: float  # The same with the prior odds of the effects
    unknown: tuple[str, ...]  # Names of the q strengths of the set, with the declared coefficients first
    values: Array  # (q,) of them
    covariance: Array  # (q, q) of them
    misfit: float  # Chi-square of the scores about them

    @property
    def sigmas(self) -> Array:
        """(q,) standard deviations of the strengths."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def strengths(self) -> dict[str, float]:
        """The strengths by name."""
        return dict(zip(self.unknown, self.values.tolist(), strict=True))


@dataclass(frozen=True)
class Weights:
    """A linear model of mean scores."""

    names: tuple[str, ...]  # Of the p strengths
    sizes: Array  # (p,) usual ones
    values: Array  # (p,) where the laws have them
    absent: Array  # (p,) means of their priors: absence, or what the model declares
    declared: int
    """Number of the first strengths, which the model declares and whose priors have the width of their size."""
    mean: Array  # (p,) of the scores less that of strokes filmed again
    spread: Array  # (p, p) its covariance
    slopes: Array  # (p, p) of the mean by each strength in usual sizes, column by column
    strokes: int  # Their number
    hypotheses: Sequence[Hypothesis] = ()
    _known: dict[frozenset[str], Set] = field(default_factory=dict)

    @cached_property
    def sets(self) -> list[Set]:
        """All sets of up to `MOST` effects, the likeliest of each size enlarged."""
        listed = {h.name: h for h in self.hypotheses}
        size = [self.weighed(())]
        for count in range(1, MOST + 1):
            best = sorted(size, key=lambda one: -one.odds)[:KEPT] if count > 2 else size
            grown = {one.names | {name} for one in best for name in listed if name not in one.names}
            size = [self.weighed(tuple(listed[name] for name in listed if name in names)) for names in grown]
        return list(self._known.values())

    def fitted(self, chosen: Sequence[Hypothesis]) -> Set:
        """The set of some effects, from what the strokes say of it and of the declared coefficients alone.

        Strengths that many other scores help to find have the small errors of all these scores: a spin that its prior
        holds back, say. Its evidence does not compare with those of other sets.
        """
        names = (*self.names[: self.declared], *(column for h in chosen for column in h.columns))
        rows = [self.names.index(name) for name in names]
        left = self.mean - self.slopes @ np.where(np.isin(self.names, names), 0.0, self._away)
        both = np.ix_(rows, rows)
        own = replace(
            self,
            names=names,
            sizes=self.sizes[rows],
            values=self.values[rows],
            absent=self.absent[rows],
            mean=left[rows],
            spread=self.spread[both],
            slopes=self.slopes[both],
            hypotheses=chosen,
            _known={},
        )
        return own.weighed(chosen)

    def known(self, names: frozenset[str]) -> Set | None:
        """A set that was weighed; None if it was not."""
        return self._known.get(names)

    def best_with(self, name: str) -> Set:
        """The most probable set that holds an effect."""
        return max((one for one in self.sets if name in one.names), key=lambda one: one.odds)

    def weighed(self, chosen: Sequence[Hypothesis]) -> Set:
        """The set of some effects."""
        names = frozenset(h.name for h in chosen)
        if names not in self._known:
            self._known[names] = self._weighed(chosen, names)
        return self._known[names]

    def _weighed(self, chosen: Sequence[Hypothesis], names: frozenset[str]) -> Set:
        own = [self._places(h) for h in chosen]
        places, left = [*range(self.declared), *(place for group in own for place in group)], self._left
        columns, found = self.slopes[:, places], list[tuple[float, Array]]()
        for widths in product(TRIED, repeat=len(chosen)):
            sigmas = np.ones(len(places))
            sigmas[self.declared :] = np.repeat(widths, [len(group) for group in own])
            root = columns * sigmas
            found.append((log_density(left, self.spread + root @ root.T), sigmas))
        evidence = float(special.logsumexp([value for value, _ in found]) - np.log(len(found)))
        sigmas = max(found, key=lambda one: one[0])[1]
        inverse = np.linalg.inv(self.spread)
        covariance = np.linalg.inv(columns.T @ inverse @ columns + np.diag(sigmas**-2.0))
        moved = covariance @ columns.T @ inverse @ left
        rest, scale = left - columns @ moved, self.sizes[places]
        values = self.absent[places] + scale * moved
        return Set(
            names,
            evidence,
            evidence + log_odds(chosen),
            tuple(self.names[place] for place in places),
            values,
            covariance * np.outer(scale, scale),
            float(rest @ inverse @ rest),
        )

    def score(self, hypothesis: Hypothesis) -> Score:
        """The score test of an effect beside the declared coefficients."""
        root, columns = self.slopes[:, : self.declared], self.slopes[:, self._places(hypothesis)]
        inverse = np.linalg.inv(self.spread + root @ root.T)
        covariance = np.linalg.pinv(columns.T @ inverse @ columns, hermitian=True)
        pull, sizes = columns.T @ inverse @ self._left, self.sizes[self._places(hypothesis)]
        explained = float(pull @ covariance @ pull)
        p_value = float(stats.chi2.sf(explained, len(sizes)))
        sigma = np.sqrt(np.diagonal(covariance)) * sizes
        return Score(covariance @ pull * sizes, sigma, explained, p_value, len(sizes), self.strokes)

    @property
    def _left(self) -> Array:
        """(p,) the mean of the scores, were all strengths where they are absent."""
        return self.mean - self.slopes @ self._away

    @property
    def _away(self) -> Array:
        """(p,) from where the laws have the strengths to where they are absent, in usual sizes."""
        return (self.absent - self.values) / self.sizes

    def _places(self, hypothesis: Hypothesis) -> list[int]:
        return [self.names.index(column) for column in hypothesis.columns]

    def by_chance(self, one: Set) -> float:
        """Probability of so large a misfit by chance (H. Hotelling 1931, for a covariance of as many strokes)."""
        count = len(self.names) - len(one.unknown)
        if count < 1 or self.strokes <= count:
            return 1.0
        ratio = one.misfit * (self.strokes - count) / (count * (self.strokes - 1))
        return float(stats.f.sf(ratio, count, self.strokes - count))


def odds_of(places: Sequence[Weights]) -> Odds:
    """Probabilities of all sets, each about the laws that say most of it, among the weights about several laws."""
    scores = dict[frozenset[str], float]()
    for one in (one for weights in places for one in weights.sets):
        scores[one.names] = max(one.odds, scores.get(one.names, -np.inf))
    return Odds(dict(zip(scores, special.softmax(list(scores.values())).tolist(), strict=True)))


def slopes_of(again: Array, changed: Sequence[Array]) -> Array:
    """(p, p) slopes of `Weights`, from scores of strokes filmed again, and with each strength larger by its size."""
    middle = clipped(again).mean(axis=0)
    return np.stack([clipped(one).mean(axis=0) - middle for one in changed], axis=1)


def mean_of(real: Array, again: Sequence[Array]) -> tuple[Array, Array]:
    """Mean of the scores, and its covariance, as of `Weights`.

    The covariance has the shape of that of strokes filmed again, of which there are more, and the size of the real
    ones' (n, p) where that is larger: what the laws lack scatters from stroke to stroke too.
    """
    found, others = clipped(real), [clipped(one) for one in again]
    middle = np.mean([one.mean(axis=0) for one in others], axis=0)
    shape = np.mean([np.atleast_2d(np.cov(one.T)) for one in others], axis=0)
    size = float(np.trace(np.linalg.solve(shape, np.atleast_2d(np.cov(found.T))))) / len(shape)
    spread = shape * (max(1.0, size) / len(found) + 1.0 / sum(len(one) for one in others))
    return found.mean(axis=0) - middle, spread
