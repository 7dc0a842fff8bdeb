"""Score tests: would an effect that is absent make the samples more probable, everything else being free to adapt?

At the minimum of the declared model the derivative of the objective by an absent effect's coefficients is its score.
First states are eliminated stretch by stretch, declared coefficients over all tracks; what information is left tells
how large the score may be by chance. Tracks are the independent units: the scatter of their scores says how far the
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
"""Tracks that the pooled scatter is worth beside an effect's own: of few tracks an own covariance is too uncertain."""
LEAST_SHARE = 1e-8
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
        q, g = self.common, self.gram
        total = g.sum(axis=0)
        share = np.linalg.solve(total[:q, :q] + np.diag(self.precision), total[:q, q:-1])
        cross = g[:, q:-1, :q] @ share
        information = g[:, q:-1, q:-1] - cross - cross.swapaxes(-1, -2) + share.T @ g[:, :q, :q] @ share
        prior = share.T @ (self.precision[:, None] * share)
        score = g[:, q:-1, -1] - g[:, :q, -1] @ share
        return Efficient(score, np.asarray(information), np.asarray(prior), np.diagonal(total)[q:-1])


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

    def dispersion(self, candidates: Sequence[Sequence[int]]) -> float:
        """How much more the tracks' scores scatter than the noise says, pooled over candidates; at least 1."""
        seen = [visible for chosen in candidates if (visible := self._visible(chosen)) is not None]
        ratios = [float(np.trace(np.linalg.solve(v.information, v.scatter))) / len(v.estimate) for v in seen]
        return max(1.0, float(np.median(ratios))) if ratios else 1.0

    def test(self, chosen: Sequence[int], dispersion: float) -> Score | None:
        """The test of one candidate's columns; None where the data do not show it at all.

        Args: chosen: its columns.  dispersion: from `dispersion`, of all candidates.
        """
        visible = self._visible(chosen)
        if visible is None:
            return None
        tracks, p = len(self.score), len(visible.estimate)
        covariance = tracks * visible.scatter + PRIOR_TRACKS * dispersion * visible.information
        covariance /= tracks + PRIOR_TRACKS
        pull = visible.information @ visible.estimate
        wald = float(pull @ np.linalg.solve(covariance, pull))
        inverse = np.linalg.inv(visible.information)
        spread = visible.directions @ inverse @ covariance @ inverse @ visible.directions.T
        return Score(
            visible.directions @ visible.estimate,
            np.sqrt(np.diagonal(spread)),
            float(visible.estimate @ pull),
            float(stats.f.sf(wald / p, p, tracks + PRIOR_TRACKS - p - 1)),
            p,
        )

    def _visible(self, chosen: Sequence[int]) -> _Visible | None:
        """What the data show of some columns, along the directions that projection leaves."""
        index = np.array(chosen)
        if not (self.raw[index] > 0.0).any():
            return None
        length = np.sqrt(np.maximum(self.raw[index], LEAST_SHARE * self.raw[index].max()))
        total = self.information.sum(axis=0)[np.ix_(index, index)] + self.prior[np.ix_(index, index)]
        value, vector = np.linalg.eigh(total / np.outer(length, length))
        if not (kept := value > LEAST_SHARE).any():
            return None
        directions = vector[:, kept] / length[:, None]
        information = directions.T @ total @ directions
        score = self.score[:, index] @ directions
        estimate = np.linalg.solve(information, score.sum(axis=0))
        left = score - (directions.T @ self.information[:, index[:, None], index] @ directions) @ estimate
        left = left - left.mean(axis=0)
        scatter = left.T @ left * len(left) / max(1, len(left) - 1)
        return _Visible(directions, estimate, information, scatter)


@dataclass(frozen=True)
class _Visible:
    """A candidate in the r directions in which it can be seen.

    Attributes:
        directions: (p, r).  estimate: (r,) one step from absent.  information: (r, r).
        scatter: (r, r) of the tracks' scores that the estimate leaves.
    """

    directions: Array
    estimate: Array
    information: Array
    scatter: Array


@dataclass(frozen=True)
class Score:
    """The outcome of a score test.

    Attributes:
        estimate: (p,) coefficients after one step from absent.
        sigma: (p,) their standard deviations.
        explained: squared whitened residual that the effect would explain: chi-square with p degrees under no effect.
        p_value: probability of so much by chance.
        rank: number of directions in which the data show the coefficients.
    """

    estimate: Array
    sigma: Array
    explained: float
    p_value: float
    rank: int
