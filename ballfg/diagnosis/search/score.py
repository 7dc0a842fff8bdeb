"""Tests by the score whether an absent effect would make the samples more probable, with all else free.

Tracks are the independent units: the scatter of their scores shows how far the stated noise can be trusted, so that
false alarms stay as rare as stated. A track pulls the estimate towards itself; R. Bell and D. McCaffrey 2002, "Bias
reduction in standard errors for linear regression with multi-stage samples", Survey Methodology 28, corrects its score
for that (CR2). docs/derivations/diagnosis.md has the derivation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from scipy import optimize, stats

from ballfg.arrays import Array, Index
from ballfg.diagnosis.evidence.prior import log_odds
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.hypotheses.signatures import Efficient, Signatures, visible_directions

PRIOR_TRACKS = 10.0  # Weight, in tracks, of the scatter pooled over all patterns, beside a pattern's own, uncertain one
LEAST_OWN = 1e-6
"""Least share of all information that a track has in every direction: it counts tracks without information, but not
rounding in columns that were nearly projected out."""
LEAST_KEPT = 0.05
"""Least remaining share of a track's score: a track that determines a direction alone cannot show its scatter."""
NOTICED: Final = 0.9  # Probability that an effect of the size `seen_from` passes the test
ALARM = 0.0025
"""Probability that a hypothesis passes the score tests of one round by chance. A trace that passes is about one whose
effect is named."""
LARGEST: Final = 1e4  # Squared size, in units of its covariance, that any test detects


@dataclass(frozen=True)
class Pattern:
    """The test of one pattern."""

    rank: int  # r, number of directions tested
    estimate: Array  # (r,) in those directions, one step from absent
    information: Array  # (r, r)
    scatter: Array  # (r, r) covariance of the score, from the tracks
    p_value: float  # Probability by chance

    @property
    def explained(self) -> float:
        """Squared whitened residual that the pattern would explain: chi-square of r degrees by chance."""
        return float(self.estimate @ self.information @ self.estimate)


@dataclass(frozen=True)
class Score:
    """The outcome of a score test."""

    estimate: Array  # (p,) coefficients after one step from absent
    sigma: Array  # (p,) their standard deviations
    explained: float  # Squared whitened residual that the effect would explain: chi-square of `rank` degrees by chance
    p_value: float  # Probability by chance
    rank: int  # Number of directions in which the data show the coefficients
    tracks: int  # Number of tracks behind the scatter

    def seen_from(self, alarm: float) -> Array:
        """(p,) detectable sizes of each coefficient, in 9 of 10 cases, whatever the others are.

        If the other coefficients are zero, smaller sizes suffice. Infinite if the data do not show the coefficient.

        Args: alarm: significance level of the test.
        """
        return self.sigma * least_noticed(self.rank, self.tracks, alarm)


@dataclass(frozen=True)
class Scored:
    """A hypothesis and the outcome of its score test, corrected for the number of hypotheses; None: not visible.

    `shapes` are the next best shapes of the effect: other places, other signs, possibly better minima.
    `tested` is the number of hypotheses, `gain` the foretold logarithm of the ratio of evidences.
    """

    hypothesis: Hypothesis
    score: Score | None
    p_value: float
    shapes: tuple[Hypothesis, ...] = ()
    tested: int = 1
    gain: float = -np.inf

    @property
    def explained(self) -> float:
        """Squared whitened residual that the hypothesis would explain; negative if it is not visible."""
        return -1.0 if self.score is None else self.score.explained

    @property
    def odds(self) -> float:
        """Foretold logarithm of the posterior odds of the model with it to that without."""
        return self.gain + log_odds([self.hypothesis])


def score_tests(signatures: Signatures, candidates: Sequence[Sequence[int]]) -> list[Score | None]:
    """One test for each candidate; None if the data do not show it at all.

    Args: candidates: for each the columns of its coefficients, counted after the common ones.
    """
    efficient = signatures.efficient()
    turns = [_visible(efficient, np.array(chosen)) for chosen in candidates]
    outcomes = iter(pattern_tests(signatures, [turn for turn in turns if turn is not None]))
    return [
        None if turn is None else _score(next(outcomes), turn[np.array(chosen)], signatures.tracks)
        for turn, chosen in zip(turns, candidates, strict=True)
    ]


def _visible(efficient: Efficient, chosen: Index) -> Array | None:
    """(p, r) the remaining directions of some of all p columns after projection; None: there is none."""
    directions = visible_directions(efficient.total[np.ix_(chosen, chosen)], efficient.raw[chosen])
    if not directions.shape[1]:
        return None
    turn = np.zeros((len(efficient.raw), directions.shape[1]))
    turn[chosen] = directions
    return turn


def _score(pattern: Pattern, turn: Array, tracks: int) -> Score:
    """Args: turn: (p, r) the coefficients of a candidate in the tested directions."""
    inverse = np.linalg.inv(pattern.information)
    spread = turn @ inverse @ pattern.scatter @ inverse @ turn.T
    # a coefficient without a visible direction has no finite uncertainty
    spread[np.diag_indices_from(spread)] += np.where((turn**2).sum(axis=1) > 0.0, 0.0, np.inf)
    sigma = np.sqrt(np.maximum(np.diagonal(spread), 0.0))
    return Score(turn @ pattern.estimate, sigma, pattern.explained, pattern.p_value, pattern.rank, tracks)


def pattern_tests(signatures: Signatures, directions: Sequence[Array]) -> list[Pattern]:
    """One test for each pattern, with pooled scatter if tracks are few.

    Args: directions: for each pattern (p, r), combinations of the p columns of all patterns.
    """
    found = [_corrected(signatures, turn) for turn in directions]
    ratios = [float(np.trace(np.linalg.solve(f.information, f.scatter))) / f.rank for f in found]
    dispersion = max(1.0, float(np.median(ratios))) if ratios else 1.0
    return [replace(f, p_value=_p_value(f, signatures.tracks, dispersion)) for f in found]


def _corrected(signatures: Signatures, turn: Array) -> Pattern:
    """The estimate of a pattern and its scatter, corrected for each track's part in the estimate; without a test."""
    q, rank = signatures.common, turn.shape[1]
    chosen = np.zeros((signatures.gram.shape[-1], q + rank + 1))
    chosen[:q, :q], chosen[q:-1, q:-1], chosen[-1, -1] = np.eye(q), turn, 1.0
    gram = chosen.T @ signatures.gram @ chosen
    own, score = gram[:, :-1, :-1], gram[:, :-1, -1]
    whole = own.sum(axis=0)
    whole[:q, :q] += np.diag(signatures.precision)
    share = np.linalg.solve(whole[:q, :q], whole[:q, q:])
    efficient = np.concatenate((-share, np.eye(rank)))
    information = efficient.T @ whole @ efficient
    estimate = np.linalg.solve(information, (score @ efficient).sum(axis=0))
    left = (score - own @ (efficient @ estimate)) @ efficient
    full = efficient.T @ own @ efficient
    kept = full - efficient.T @ own @ np.linalg.inv(whole) @ own @ efficient
    unit = np.linalg.inv(np.linalg.cholesky(information))  # all tracks together have the information one
    apart = [
        _as_if_apart(unit @ s, unit @ f @ unit.T, unit @ k @ unit.T) for s, f, k in zip(left, full, kept, strict=True)
    ]
    left = np.stack(apart) @ np.linalg.inv(unit).T
    return Pattern(rank, estimate, information, left.T @ left, 1.0)


def _as_if_apart(left: Array, full: Array, kept: Array) -> Array:
    """(r,) a track's score with the scatter that it would have without its part in the estimate.

    Args: full, kept: (r, r) its covariance without and with the track's part, for noise as stated.
    """
    values, vectors = np.linalg.eigh(full)
    lengths = np.sqrt(np.maximum(values, LEAST_OWN))
    root, inverse = vectors * lengths, (vectors / lengths).T
    values, vectors = np.linalg.eigh(inverse @ kept @ inverse.T)
    grown = vectors / np.sqrt(np.maximum(values, LEAST_KEPT)) @ vectors.T
    return np.asarray(root @ grown @ inverse @ left)


def _p_value(pattern: Pattern, tracks: int, dispersion: float) -> float:
    covariance = tracks * pattern.scatter + PRIOR_TRACKS * dispersion * pattern.information
    pull = pattern.information @ pattern.estimate
    wald = (tracks + PRIOR_TRACKS) * float(pull @ np.linalg.solve(covariance, pull))
    freedom, left = _freedom(pattern.rank, tracks)
    return float(stats.f.sf(wald * left / (freedom * pattern.rank), pattern.rank, left))


def _freedom(rank: int, tracks: int) -> tuple[float, float]:
    """Degrees of freedom of the scatter, before and after Hotelling's correction for the estimated covariance."""
    freedom = tracks + PRIOR_TRACKS - 1.0
    return freedom, freedom - rank + 1.0


@lru_cache(maxsize=1024)
def least_noticed(rank: int, tracks: int, alarm: float) -> float:
    """The size of an effect, in standard deviations, that the test detects in 9 of 10 cases.

    Args: rank: number of tested directions.  tracks: their number.  alarm: significance level.
    """
    _, left = _freedom(rank, tracks)
    limit = float(stats.f.isf(alarm, rank, left))

    def missing(square: float) -> float:
        return float(stats.ncf.sf(limit, rank, left, square)) - NOTICED

    return float(np.sqrt(optimize.brentq(missing, 1e-6, LARGEST, rtol=1e-6)))
