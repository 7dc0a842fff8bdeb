"""Estimates the mean and spread of coefficients over a population of tracks by empirical Bayes.

Track i has a Gaussian likelihood of its own coefficients b_i, with the information L_i and the vector h_i = L_i y_i;
the information is zero in directions that the track does not observe. The tracks are draws b_i ~ N(theta, D) with a
diagonal D, and theta ~ N(start, sigma^2) is the prior of the model. theta and D maximise the likelihood of all tracks
with every b_i integrated out, times the prior of theta (N. Laird, J. Ware, "Random-effects models for longitudinal
data", Biometrics 38, 1982). Given D, theta is a least-squares solution; D follows by the minorisation step of H. Zhou,
L. Hu, J. Zhou, K. Lange, "MM algorithms for variance components models", J. Comput. Graph. Stat. 28, 2019, which never
lowers the likelihood and needs no step size.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from ballfg.arrays import Array

MAX_STEPS = 20_000
"""Largest number of iterations: some tens are usual, thousands for a spread close to zero. A step takes 50 us."""
STEP_TOLERANCE = 1e-11
"""Relative change of every variance at which the iteration ends."""
NO_SPREAD = 1e-10
"""Variance, as a share of the prior's, below which it is zero."""
MOST_SPREAD = 100.0
"""Largest variance, as a multiple of the prior's: tracks with almost no information set no limit."""
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
    """

    mean: Array
    covariance: Array
    spread: Array
    log_likelihood: float

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


def fit_population(tracks: Sequence[Evidence], start: Array, sigma: Array, low: Array, high: Array) -> Population:
    """Mean and spread of maximum marginal likelihood, the mean within its bounds.

    Args:
        tracks: at least one.
        start: (p,) mean of the prior of the population's mean.  sigma: (p,) its standard deviation.
        low: (p,) least mean.  high: (p,) largest mean.
    Raises: ValueError: if there is no track.
    """
    if not tracks:
        raise ValueError("tracks must hold at least one; got none. Every estimate may have failed.")
    scale = np.outer(sigma, sigma)
    information = np.stack([t.information for t in tracks]) * scale
    moved = np.stack([t.vector + t.information @ (t.about - start) for t in tracks]) * sigma
    bounds = ((low - start) / sigma, (high - start) / sigma)
    seen = np.einsum("ikk->k", information) > NO_INFORMATION
    variance = np.where(seen, 1.0, 0.0)
    for _ in range(MAX_STEPS):
        mean = _mean(information, moved, variance, bounds)
        # the pulls as large as they are, against as large as they should be
        pulls = (_residual(information, moved, variance, mean) ** 2).sum(axis=0)
        expected = np.einsum("ikk->k", _marginal(information, variance))
        growth = np.sqrt(np.divide(pulls, expected, out=np.zeros_like(pulls), where=expected > 0.0))
        updated = np.minimum(variance * growth, MOST_SPREAD)
        updated[updated < NO_SPREAD] = 0.0
        change = np.abs(updated - variance)
        done = bool((change <= STEP_TOLERANCE * variance).all())
        variance = updated
        if done:
            break
    mean = _mean(information, moved, variance, bounds)
    precision = np.eye(len(start)) + _marginal(information, variance).sum(axis=0)
    return Population(
        mean=np.clip(start + sigma * mean, low, high),
        covariance=np.linalg.inv(precision) * scale,
        spread=sigma * np.sqrt(variance),
        log_likelihood=_log_likelihood(information, moved, variance, mean),
    )


def _mixing(information: Array, variance: Array) -> Array:
    """(n, p, p) I + L_i D."""
    return np.eye(len(variance)) + information * variance


def _marginal(information: Array, variance: Array) -> Array:
    """(n, p, p) information of each track on the mean, its own deviation integrated out: (I + L_i D)^-1 L_i."""
    found = np.linalg.solve(_mixing(information, variance), information)
    return (found + found.swapaxes(-1, -2)) / 2.0


def _mean(information: Array, moved: Array, variance: Array, bounds: tuple[Array, Array]) -> Array:
    """(p,) the best mean for a given spread."""
    mixing = _mixing(information, variance)
    precision = np.eye(len(variance)) + _marginal(information, variance).sum(axis=0)
    target = np.linalg.solve(mixing, moved[..., None])[..., 0].sum(axis=0)
    free = np.linalg.solve(precision, target)
    if ((bounds[0] <= free) & (free <= bounds[1])).all():
        return np.asarray(free)
    root = np.linalg.cholesky(precision).T
    return np.asarray(lsq_linear(root, np.linalg.solve(root.T, target), bounds, method="bvls").x)


def _residual(information: Array, moved: Array, variance: Array, mean: Array) -> Array:
    """(n, p) each track's pull on the mean."""
    pull = (moved - information @ mean)[..., None]
    return np.asarray(np.linalg.solve(_mixing(information, variance), pull)[..., 0])


def _log_likelihood(information: Array, moved: Array, variance: Array, mean: Array) -> float:
    """Marginal log likelihood and log prior of the mean, without their constants."""
    _, log_determinant = np.linalg.slogdet(_mixing(information, variance))
    pull = moved - information @ mean
    explained = (pull * variance * _residual(information, moved, variance, mean)).sum()
    quadratic = (mean @ information @ mean).sum() - 2.0 * moved.sum(axis=0) @ mean - explained + mean @ mean
    return float(-0.5 * (log_determinant.sum() + quadratic))
