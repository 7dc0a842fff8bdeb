"""What is computed from errors: root mean squares, NEES, coverage, and intervals for all of them by the bootstrap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2, norm

Array = NDArray[np.float64]
Index = NDArray[np.int64]

RESAMPLES = 1000
"""Of the bootstrap: the ends of a 95 % interval then move by about a tenth of its length."""
CONFIDENCE = 0.95
"""Of the bootstrap intervals."""
BAND = 0.99
"""Of the chi-square bands."""

Statistic = Callable[[Index], Array]
"""From track numbers (b, m), b resamples of m tracks, to a figure for each resample (b,)."""


@dataclass(frozen=True)
class Figure:
    """A number with an interval."""

    value: float
    low: float
    high: float


def square_norms(errors: Array) -> Array:
    """(n,) squared lengths of error vectors (n, d)."""
    return np.asarray(np.einsum("nd,nd->n", errors, errors))


def nees(errors: Array, covariances: Array) -> Array:
    """(n,) e^T P^-1 e of errors (n, d) with covariances (n, d, d): chi-square with d degrees of freedom."""
    return np.asarray(np.einsum("nd,nd->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]))


def chi_square_band(dof: int, count: int, level: float = BAND) -> tuple[float, float]:
    """The interval that holds the mean of `count` independent chi-square numbers of `dof` degrees with a probability.

    Raises: ValueError: if dof or count is not positive.
    """
    if dof < 1 or count < 1:
        raise ValueError(f"dof and count must be positive; got {dof} and {count}")
    low, high = chi2.ppf([(1 - level) / 2, (1 + level) / 2], dof * count) / count
    return float(low), float(high)


def inside(errors: Array, sigmas: Array, level: float) -> NDArray[np.bool_]:
    """Whether each error lies in the central interval of a normal distribution that should hold `level` of them."""
    return np.asarray(np.abs(errors) <= norm.ppf((1 + level) / 2) * sigmas)


def bootstrap(statistic: Statistic, count: int, rng: np.random.Generator) -> Figure:
    """A figure over tracks, with its percentile interval when tracks are drawn with replacement.

    Args:
        statistic: vectorised over resamples.
        count: number of tracks.
        rng: draws them.
    Raises: ValueError: if there is no track.
    """
    if count < 1:
        raise ValueError("a figure needs at least one track; got none")
    value = float(statistic(np.arange(count)[None])[0])
    drawn = statistic(rng.integers(0, count, size=(RESAMPLES, count)))
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Figure(value, float(low), float(high))


def pooled_rms(sums: ArrayLike, counts: ArrayLike) -> Statistic:
    """The statistic sqrt(sum of squares / number) over all samples of all tracks.

    Args: sums: (m,) of squares in each track.  counts: (m,) samples in each track.
    """
    total, number = np.asarray(sums, dtype=np.float64), np.asarray(counts, dtype=np.float64)
    return lambda tracks: np.sqrt(total[tracks].sum(-1) / number[tracks].sum(-1))


def pooled_mean(sums: ArrayLike, counts: ArrayLike) -> Statistic:
    """The statistic sum / number over all samples of all tracks."""
    total, number = np.asarray(sums, dtype=np.float64), np.asarray(counts, dtype=np.float64)
    return lambda tracks: total[tracks].sum(-1) / number[tracks].sum(-1)


def ratio(above: Statistic, below: Statistic) -> Statistic:
    """One statistic divided by another, on the same resamples: tracks that are hard for both cancel."""
    return lambda tracks: above(tracks) / below(tracks)


def quantile(values: ArrayLike, q: float) -> Statistic:
    """The statistic that is a quantile of one value (m,) per track."""
    per_track = np.asarray(values, dtype=np.float64)
    return lambda tracks: np.quantile(per_track[tracks], q, axis=-1)
