"""Score tests: would an effect that is absent make the samples more probable, everything else being free to adapt?

At the minimum of the declared model the derivative of the objective by an absent effect's coefficients is its score.
First states are eliminated stretch by stretch, declared coefficients over all tracks; what information is left tells how
large the score may be by chance. Tracks are the independent units: the scatter of their scores says how far the
stated noise can be trusted, so that a false alarm stays as rare as stated when noise is misjudged or has a memory.
docs/derivations/diagnosis.md derives all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

PRIOR_TRACKS = 10.0
"""Tracks that the pooled scatter is worth beside an effect's own: with few tracks an own covariance is too uncertain."""
LEAST_SHARE = 1e-9
"""Share of a column's length that must survive projection: less is rounding, and the effect cannot be seen at all."""


@dataclass(frozen=True)
class Signatures:
    """Inner products of projected columns, summed over each of t tracks.

    Attributes:
        gram: (t, q + p + 1, q + p + 1): q common columns, p columns of candidates, the residual.
        precision: (q,) priors of the common ones.
        common: q.
    """

    gram: Array
    precision: Array
    common: int

    @property
    def tracks(self) -> int:
        """Number of tracks."""
        return len(self.gram)

    def efficient(self) -> Efficient:
        """Scores and information of the candidates with the common columns projected out too."""
        q, total = self.common, self.gram.sum(axis=0)
        share = np.zeros((q, total.shape[0] - q))
        if q:
            share = np.linalg.solve(total[:q, :q] + np.diag(self.precision), total[:q, q:-1])
        else:
            share = share[:, :-1]
        share = share[:, : total.shape[0] - q - 1]
        g = self.gram
        score = g[:, q:-1, -1] - g[:, :q, -1] @ share
        cross = g[:, q:-1, :q] @ share
        own = g[:, q:-1, q:-1] - cross - cross.swapaxes(-1, -2) + share.T @ g[:, :q, :q] @ share
        prior = share.T @ (self.precision[:, None] * share)
        raw = np.diagonal(total)[q:-1]
        return Efficient(score, np.asarray(own), prior, raw)


@dataclass(frozen=True)
class Efficient:
    """Scores of p columns on t tracks.

    Attributes:
        score: (t, p).  information: (t, p, p).
        prior: (p, p) information that the priors of common columns leave.
        raw: (p,) squared length of each column before common columns were projected out.
    """

    score: Array
    information: Array
    prior: Array
    raw: Array

    def total(self) -> Array:
        """(p, p) information over all tracks."""
        return np.asarray(self.information.sum(axis=0) + self.prior)

    def dispersion(self, columns: Sequence[Sequence[int]]) -> float:
        """How much more the tracks' scores scatter than the noise says, pooled over candidates; at least 1."""
        ratios = []
        for chosen in columns:
            result = self._wald(chosen)
            if result is not None:
                _, information, scatter = result
                ratios.append(float(np.trace(np.linalg.solve(information, scatter))) / len(chosen))
        return max(1.0, float(np.median(ratios))) if ratios else 1.0

    def test(self, chosen: Sequence[int], dispersion: float) -> Score | None:
        """The test of one candidate's columns; None where the data do not show it at all."""
        result = self._wald(chosen)
        if result is None:
            return None
        estimate, information, scatter = result
        tracks, p = len(self.score), len(chosen)
        covariance = (tracks * scatter + PRIOR_TRACKS * dispersion * information) / (tracks + PRIOR_TRACKS)
        pull = information @ estimate
        wald = float(pull @ np.linalg.solve(covariance, pull))
        p_value = float(stats.f.sf(wald / p, p, tracks + PRIOR_TRACKS - p - 1))
        inverse = np.linalg.inv(information)
        return Score(
            estimate,
            np.sqrt(np.diagonal(inverse @ covariance @ inverse)),
            float(estimate @ information @ estimate),
            p_value,
        )

    def _wald(self, chosen: Sequence[int]) -> tuple[Array, Array, Array] | None:
        """One-step estimate (p,), its information (p, p), scatter (p, p) of the scores that the estimate leaves."""
        index = np.array(chosen)
        information = self.total()[np.ix_(index, index)]
        length = np.sqrt(self.raw[index])
        if not (length > 0).all():
            return None
        scaled = information / np.outer(length, length)
        if np.linalg.eigvalsh(scaled)[0] < LEAST_SHARE:
            return None
        estimate = np.linalg.solve(information, self.score[:, index].sum(axis=0))
        left = self.score[:, index] - self.information[:, index[:, None], index] @ estimate
        left = left - left.mean(axis=0)
        scatter = left.T @ left * len(left) / max(1, len(left) - 1)
        return estimate, information, np.asarray(scatter)


@dataclass(frozen=True)
class Score:
    """The outcome of a score test.

    Attributes:
        estimate: (p,) coefficients after one step from absent.
        sigma: (p,) their standard deviations.
        explained: squared whitened residual that the effect would explain: chi-square with p degrees under no effect.
        p_value: probability of so much by chance.
    """

    estimate: Array
    sigma: Array
    explained: float
    p_value: float
