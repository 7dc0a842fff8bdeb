"""Estimates the mean and spread of coefficients over a population of tracks by empirical Bayes.

Track i has a Gaussian likelihood of its own coefficients b_i, with the information L_i and the vector h_i = L_i y_i;
the information is zero in directions that the track does not observe. The tracks are draws b_i ~ N(theta, D) with a
diagonal D, and theta ~ N(start, sigma^2) is the prior of the model. theta and D maximise the likelihood of all tracks
with every b_i integrated out, times the prior of theta (N. Laird, J. Ware, "Random-effects models for longitudinal
data", Biometrics 38, 1982). Given D, theta is a least-squares solution; D follows by the minorisation step of H. Zhou,
L. Hu, J. Zhou, K. Lange, "MM algorithms for variance components models", J. Comput. Graph. Stat. 28, 2019, which never
lowers the likelihood and needs no step size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from ballfg.arrays import Array, Index

MAX_STEPS = 20_000
"""Largest number of iterations, two steps and an extrapolation each; some tens are usual."""
STEP_TOLERANCE = 1e-11
"""Relative change of every variance at which the iteration ends."""
NO_SPREAD = 1e-10
"""Variance, as a share of the prior's, below which it is zero."""
MOST_SPREAD = 100.0
"""Largest variance, as a multiple of the prior's: tracks with almost no information set no limit."""
LONGEST, MOST_CHANGE = 1e3, 5.0
"""Bounds of an extrapolation: its length in steps, and the change of a variance's logarithm."""
NO_INFORMATION = 1e-2
"""Information of all tracks, as a share of the prior's, below which the spread of a coefficient is zero."""


@dataclass(frozen=True)
class Evidence:
    """Gaussian likelihood of p coefficients from one track's measurements, without a prior.

    Attributes:
        information: (p, p), positive semidefinite.
        vector: (p,) information times the most likely values, relative to `about`.
        about: (p,) the values about which the track was linearised.
    """

    information: Array
    vector: Array
    about: Array


@dataclass(frozen=True)
class Population:
    """The population of coefficients.

    Attributes:
        mean: (p,).
        covariance: (p, p) of the mean, for the spread found.
        spread: (p,) standard deviation between tracks.
        log_likelihood: marginal, up to a constant, with the prior of the mean.
        log_evidence: the same with the mean integrated out too, to compare priors of the mean.
    """

    mean: Array
    covariance: Array
    spread: Array
    log_likelihood: float
    log_evidence: float

    @property
    def sigma(self) -> Array:
        """(p,) standard error of the mean."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def next_track(self) -> Array:
        """(p,) standard deviation of a new track's coefficients about the mean."""
        return np.sqrt(np.diag(self.covariance) + self.spread**2)


def evidence(mean: Array, covariance: Array, prior_mean: Array, prior_sigma: Array) -> Evidence:
    """A track's likelihood from its posterior, by removing the information of the prior.

    Args:
        mean: (p,) posterior mean.  covariance: (p, p) posterior covariance.
        prior_mean: (p,).  prior_sigma: (p,) standard deviations of the independent prior.
    Raises: ValueError: if the covariance is not positive definite or anything is not finite.
    """
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError("mean and covariance must be finite; the estimate failed")
    scale = np.outer(prior_sigma, prior_sigma)
    whitened = covariance / scale
    values, vectors = np.linalg.eigh((whitened + whitened.T) / 2.0)
    if not values[0] > 0.0:
        raise ValueError(f"covariance must be positive definite; its least eigenvalue is {values[0]:g} prior variances")
    # rounding leaves slightly less than the prior's information in directions that the track does not observe
    gained = np.maximum(1.0 / values - 1.0, 0.0)
    seen = gained > 0.0
    turned = vectors.T @ ((mean - prior_mean) / prior_sigma)
    information = (vectors * gained) @ vectors.T
    vector = vectors @ np.where(seen, turned / values, 0.0)
    return Evidence(information / scale, vector / prior_sigma, np.array(prior_mean))


def fit_population(
    tracks: Sequence[Evidence],
    start: Array,
    sigma: Array,
    low: Array,
    high: Array,
    numbers: Index | None = None,
    alike: Index | None = None,
) -> Population:
    """Mean and spread of maximum marginal likelihood, the mean within its bounds.

    Args:
        tracks: at least one, each with k coefficients.
        start: (p,) mean of the prior of the population's mean.  sigma: (p,) its standard deviation.
        low: (p,) least mean.  high: (p,) largest mean.
        numbers: (n, k) which of the p means each coefficient of each track is a draw about: those of its group. None:
            the same for all tracks.
        alike: numbers of the means that all tracks share, without spread between them.
    Raises: ValueError: if there is no track.
    """
    if not tracks:
        raise ValueError("tracks must hold at least one; got none. Every estimate may have failed.")
    size = len(start)
    numbers = np.tile(np.arange(size), (len(tracks), 1)) if numbers is None else numbers
    scale = sigma[numbers]
    information = np.stack([t.information for t in tracks]) * scale[:, :, None] * scale[:, None, :]
    begun = start[numbers]
    moved = np.stack([t.vector + t.information @ (t.about - b) for t, b in zip(tracks, begun, strict=True)]) * scale
    bounds = ((low - start) / sigma, (high - start) / sigma)
    about = _Means(numbers, size, bounds)
    variance = np.where(about.summed(np.einsum("ikk->ik", information)) > NO_INFORMATION, 1.0, 0.0)
    variance[[] if alike is None else alike] = 0.0
    fit = _Fit(information, moved, about)
    for _ in range(MAX_STEPS):
        once = fit.updated(variance)
        if (np.abs(once - variance) <= STEP_TOLERANCE * variance).all():
            variance = once
            break
        twice = fit.updated(once)
        further = _further(variance, once, twice)
        variance = further if fit.log_likelihood(further) > fit.log_likelihood(twice) else twice
    own = variance[numbers]
    mean = about.best(information, moved, own)
    precision = about.precision(information, own)
    likelihood = fit.log_likelihood(variance)
    return Population(
        mean=np.clip(start + sigma * mean, low, high),
        covariance=np.linalg.inv(precision) * np.outer(sigma, sigma),
        spread=sigma * np.sqrt(variance),
        log_likelihood=likelihood,
        log_evidence=likelihood - 0.5 * float(np.linalg.slogdet(precision)[1]),
    )


@dataclass(frozen=True)
class _Fit:
    """The marginal likelihood of tracks with information (n, k, k) and vectors (n, k), by the variances (p,)."""

    information: Array
    moved: Array
    about: _Means

    def updated(self, variance: Array) -> Array:
        """(p,) the variances after one step: the pulls as large as they are, against as large as they should be."""
        own = variance[self.about.numbers]
        mean = self.about.best(self.information, self.moved, own)
        pulls = self.about.summed(_residual(self.information, self.moved, own, mean[self.about.numbers]) ** 2)
        expected = self.about.summed(np.einsum("ikk->ik", _marginal(self.information, own)))
        growth = np.sqrt(np.divide(pulls, expected, out=np.zeros_like(pulls), where=expected > 0.0))
        found = np.minimum(variance * growth, MOST_SPREAD)
        found[found < NO_SPREAD] = 0.0
        return found

    def log_likelihood(self, variance: Array) -> float:
        """At the best means, with their prior."""
        own = variance[self.about.numbers]
        mean = self.about.best(self.information, self.moved, own)
        found = _log_likelihood(self.information, self.moved, own, mean[self.about.numbers])
        return found - 0.5 * float(mean @ mean)


def _further(start: Array, once: Array, twice: Array) -> Array:
    """Variances (p,) extrapolated from two steps, in logarithms; a variance that vanished stays zero.

    The steps alone converge slowly where a variance is hardly determined. Source: R. Varadhan, C. Roland, "Simple and
    globally convergent methods for accelerating the convergence of any EM algorithm", Scand. J. Statist. 35, 2008.
    """
    left = (start > 0.0) & (once > 0.0) & (twice > 0.0)
    first, second = np.log(once[left] / start[left]), np.log(twice[left] / once[left])
    change = second - first
    length = float(np.linalg.norm(change))
    if length == 0.0:
        return twice
    ratio = min(float(np.linalg.norm(first)) / length, LONGEST)
    found = twice.copy()
    found[left] = start[left] * np.exp(np.clip(2.0 * ratio * first + ratio**2 * change, -MOST_CHANGE, MOST_CHANGE))
    return np.minimum(found, MOST_SPREAD)


def _mixing(information: Array, variance: Array) -> Array:
    """(n, k, k) I + L_i D_i, with the variances (n, k) of each track's group."""
    return np.eye(variance.shape[1]) + information * variance[:, None, :]


def _marginal(information: Array, variance: Array) -> Array:
    """(n, k, k) information of each track on the mean, its own deviation integrated out: (I + L_i D)^-1 L_i."""
    found = np.linalg.solve(_mixing(information, variance), information)
    return (found + found.swapaxes(-1, -2)) / 2.0


def _residual(information: Array, moved: Array, variance: Array, mean: Array) -> Array:
    """(n, k) each track's pull on the means (n, k) of its group."""
    pull = moved[..., None] - information @ mean[..., None]
    return np.asarray(np.linalg.solve(_mixing(information, variance), pull)[..., 0])


def _log_likelihood(information: Array, moved: Array, variance: Array, mean: Array) -> float:
    """Marginal log likelihood, without its constants, with the means (n, k) of each track's group."""
    _, log_determinant = np.linalg.slogdet(_mixing(information, variance))
    pull = moved - (information @ mean[..., None])[..., 0]
    explained = (pull * variance * _residual(information, moved, variance, mean)).sum()
    quadratic = np.einsum("ij,ijk,ik->", mean, information, mean) - 2.0 * (moved * mean).sum() - explained
    return float(-0.5 * (log_determinant.sum() + quadratic))


@dataclass(frozen=True)
class _Means:
    """The p means; numbers (n, k) say which ones each track's coefficients are draws about; bounds of the means."""

    numbers: Index
    size: int
    bounds: tuple[Array, Array]

    def summed(self, values: Array) -> Array:
        """(p,) sums of values (n, k) by mean."""
        return np.asarray(np.bincount(self.numbers.ravel(), values.ravel(), minlength=self.size), dtype=np.float64)

    def precision(self, information: Array, variance: Array) -> Array:
        """(p, p) of the means, their prior included."""
        found = np.eye(self.size)
        np.add.at(found, (self.numbers[:, :, None], self.numbers[:, None, :]), _marginal(information, variance))
        return found

    def best(self, information: Array, moved: Array, variance: Array) -> Array:
        """(p,) the best means for some variances (n, k)."""
        target = self.summed(np.asarray(np.linalg.solve(_mixing(information, variance), moved[..., None])[..., 0]))
        precision = self.precision(information, variance)
        free = np.linalg.solve(precision, target)
        if ((self.bounds[0] <= free) & (free <= self.bounds[1])).all():
            return np.asarray(free)
        root = np.linalg.cholesky(precision).T
        return np.asarray(lsq_linear(root, np.linalg.solve(root.T, target), self.bounds, method="bvls").x)
