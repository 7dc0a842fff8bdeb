"""Inner products of projected columns, track by track: all that tests of candidate effects need of the data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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

    @property
    def total(self) -> Array:
        """(p, p) information over all tracks."""
        return np.asarray(self.information.sum(axis=0) + self.prior)


def visible_directions(information: Array, raw: Array) -> Array:
    """(p, r) the directions of p coefficients that projection leaves; r is zero where it leaves none.

    Args:
        information: (p, p), everything else projected out.
        raw: (p,) information of each coefficient if all else were known.
    """
    if not (raw > 0.0).any():
        return np.zeros((len(raw), 0))
    length = np.sqrt(np.maximum(raw, LEAST_SHARE * raw.max()))
    value, vector = np.linalg.eigh(information / np.outer(length, length))
    return np.asarray(vector[:, value > LEAST_SHARE] / length[:, None])
