"""Computes figures from errors: root mean squares, NEES, coverage, shares, quantiles, and their intervals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, chi2, norm

from ballfg.arrays import Array, Index

RESAMPLES = 1000  # Number of bootstrap samples: the ends of a 95 % interval then vary by about a tenth of its length
CONFIDENCE = 0.95  # Level of the bootstrap's and of Wilson's intervals
BAND = 0.99  # Level of the chi-square bands

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


def root_mean_square(errors: Array) -> float:
    """Root mean square length of error vectors (n, d)."""
    return float(np.sqrt(square_norms(errors).mean()))


def nees(errors: Array, covariances: Array) -> Array:
    """(n,) e^T P^-1 e of errors (n, d) with covariances (n, d, d): chi-square with d degrees of freedom."""
    return np.asarray(np.einsum("nd,nd->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0]))


def chi_square_band(dof: int, count: int) -> tuple[float, float]:
    """The interval that holds the mean of `count` independent chi-square numbers of `dof` degrees with 99 %."""
    low, high = chi2.ppf([(1 - BAND) / 2, (1 + BAND) / 2], dof * count) / count
    return float(low), float(high)


def inside(errors: Array, sigmas: Array, level: float) -> NDArray[np.bool_]:
    """True for errors in the central interval of a normal distribution that should hold `level` of them."""
    return np.asarray(np.abs(errors) <= norm.ppf((1 + level) / 2) * sigmas)


def share(outcomes: Sequence[bool]) -> Figure:
    """The share of true outcomes, with Wilson's interval. Raises: ValueError: if there is no outcome."""
    if not outcomes:
        raise ValueError("outcomes must not be empty; got none. Count something first.")
    interval = binomtest(sum(outcomes), len(outcomes)).proportion_ci(CONFIDENCE, method="wilson")
    return Figure(sum(outcomes) / len(outcomes), float(interval.low), float(interval.high))


def median_and_range(values: Sequence[float]) -> Figure:
    """The median of some values (n,), with the lowest and the highest one. Raises: ValueError: if there is no value."""
    if not values:
        raise ValueError("values must not be empty; got none. Measure something first.")
    return Figure(float(np.median(values)), min(values), max(values))


def median_and_quartiles(values: Sequence[float]) -> Figure:
    """The median of some values (n,), with their lower and upper quartile."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return Figure(float(middle), float(low), float(high))


def bootstrap(statistic: Statistic, count: int, rng: np.random.Generator) -> Figure:
    """A figure over `count` tracks, with its percentile interval when tracks are drawn with replacement."""
    if count < 1:
        raise ValueError("a figure needs at least one track; got none")
    value = float(statistic(np.arange(count)[None])[0])
    drawn = statistic(rng.integers(0, count, size=(RESAMPLES, count)))
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Figure(value, float(low), float(high))


def pooled_mean(sums: ArrayLike, counts: ArrayLike) -> Statistic:
    """The statistic sum / number over all samples of all tracks, from each track's sum and number (m,)."""
    total, number = np.asarray(sums, dtype=np.float64), np.asarray(counts, dtype=np.float64)
    return lambda tracks: total[tracks].sum(-1) / number[tracks].sum(-1)


def pooled_rms(sums: ArrayLike, counts: ArrayLike) -> Statistic:
    """The statistic sqrt(sum of squares / number) over all samples of all tracks."""
    mean_square = pooled_mean(sums, counts)
    return lambda tracks: np.sqrt(mean_square(tracks))


def ratio(above: Statistic, below: Statistic) -> Statistic:
    """One statistic divided by another, on the same resamples: tracks that are hard for both cancel."""
    return lambda tracks: above(tracks) / below(tracks)


def quantile(values: ArrayLike, q: float) -> Statistic:
    """The statistic that is a quantile of one value (m,) per track."""
    per_track = np.asarray(values, dtype=np.float64)
    return lambda tracks: np.quantile(per_track[tracks], q, axis=-1)
