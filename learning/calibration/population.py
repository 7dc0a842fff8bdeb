"""Estimates the mean and spread of coefficients over a population of tracks by empirical Bayes.

Track i has a Gaussian likelihood of its own coefficients b_i, with the information L_i and the vector h_i = L_i y_i;
the information is zero in directions that the track does not observe. The tracks are draws b_i ~ N(theta, D) with a
diagonal D, and theta ~ N(start, sigma^2) is the prior of the model. theta and D maximise the likelihood of all tracks
with every b_i integrated out (N. Laird, J. Ware, "Random-effects models for longitudinal data", Biometrics 38, 1982),
times the priors of theta and of D. The prior of a spread is a Rayleigh distribution about the prior's sigma. It rises
from zero, so that a few tracks that happen to agree do not show a spread of zero (Y. Chung, S. Rabe-Hesketh, V. Dorie,
A. Gelman, J. Liu, "A nondegenerate penalized likelihood estimator for variance parameters in multilevel models",
Psychometrika 78, 2013), and ends where the tracks set no limit. Given D, theta is a least-squares solution. D follows
by Fisher scoring, or where that is worse by the minorisation step of H. Zhou, L. Hu, J. Zhou, K. Lange, "MM algorithms
for variance components models", J. Comput. Graph. Stat. 28, 2019, which never lowers the maximum's objective and needs
no step size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear

from ballfg.arrays import Array, Index

MAX_STEPS = 500  # Largest number of iterations, a step of each sort; ten are usual
STEP_TOLERANCE = 1e-11  # Relative change of every variance at which the iteration ends
LARGEST_FALL = 10.0  # A step of Fisher scoring divides no variance by more
NO_INFORMATION = 1e-2
"""Information of all tracks, as a share of the prior's, below which a coefficient has no spread but its prior."""


@dataclass(frozen=True)
class Evidence:
    """Gaussian likelihood of p coefficients from one track's measurements, without a prior."""

    information: Array  # (p, p), positive semidefinite
    vector: Array  # (p,) information times the most likely values, relative to `about`
    about: Array  # (p,) the values about which the track was linearised


@dataclass(frozen=True)
class Population:
    """The population of coefficients."""

    mean: Array  # (p,)
    covariance: Array  # (p, p) of the mean, for the spread found
    spread: Array  # (p,) standard deviation between tracks
    log_likelihood: float  # marginal, up to a constant, with the priors of mean and spread
    log_evidence: float  # the same with the mean integrated out too, to compare priors of the mean

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
    fit = _Fit(information, moved, about, variance)
    for _ in range(MAX_STEPS):
        once = fit.at(fit.updated)
        if (np.abs(once.variance - fit.variance) <= STEP_TOLERANCE * fit.variance).all():
            break
        scored = fit.at(fit.scored)
        fit = scored if scored.log_likelihood > once.log_likelihood else once
    return Population(
        mean=np.clip(start + sigma * fit.mean, low, high),
        covariance=np.linalg.inv(fit.precision) * np.outer(sigma, sigma),
        spread=sigma * np.sqrt(fit.variance),
        log_likelihood=fit.log_likelihood,
        log_evidence=fit.log_likelihood - 0.5 * float(np.linalg.slogdet(fit.precision)[1]),
    )


def agreeing(tracks: Sequence[Evidence], mean: Array) -> list[Evidence]:
    """The tracks with their information divided by chi^2 / degrees of freedom about a common mean, if that is above 1.

    Tracks that share their coefficients and contradict each other know less than they state (R. Birge, "The
    calculation of errors by the method of least squares", Phys. Rev. 40, 1932).

    Args: mean: (p,) of all tracks, fitted to them.
    """
    left = [track.vector - track.information @ (mean - track.about) for track in tracks]
    chi2 = sum(float(r @ np.linalg.pinv(t.information, hermitian=True) @ r) for r, t in zip(left, tracks, strict=True))
    freedom = sum(int(np.linalg.matrix_rank(t.information, hermitian=True)) for t in tracks) - len(mean)
    factor = max(1.0, chi2 / freedom) if freedom > 0 else 1.0
    return [replace(t, information=t.information / factor, vector=t.vector / factor) for t in tracks]


class _Fit:
    """Tracks with information L (n, k, k) and vectors h (n, k), their deviations of some variances integrated out.

    With the variances D of a track the information on its means is M = (I + L D)^-1 L, the vector g = (I + L D)^-1 h.
    Only numbers that vary are solved for: (I + L D)^-1 = I - L R (I + R L R)^-1 R with the roots R of D.

    Attributes:
        variance: (p,) of each mean's draws; zero for means without a spread.
        mean: (p,) the best means.  precision: (p, p) of them, with their prior.
        log_likelihood: marginal, without its constants, with the priors of means and spreads.
    """

    def __init__(self, information: Array, moved: Array, about: "_Means", variance: Array) -> None:
        self.information, self.moved, self.about, self.variance = information, moved, about, variance
        own = variance[about.numbers]
        varies = own.any(axis=0)
        roots = np.sqrt(own[:, varies])[:, :, None]
        pulled = roots * information[:, varies]
        inner = np.eye(roots.shape[1]) + pulled[:, :, varies] * roots.swapaxes(1, 2)
        pushed = roots * moved[:, varies, None]
        solved = np.linalg.solve(inner, np.concatenate((pulled, pushed), axis=2))
        self._marginal = information - pulled.swapaxes(1, 2) @ solved[:, :, :-1]
        self._vector = moved - (pulled.swapaxes(1, 2) @ solved[:, :, -1:])[..., 0]
        self.precision, target = about.precision(self._marginal), about.summed(self._vector)
        self.mean = about.best(self.precision, target)
        quadratic = (
            self.mean @ self.precision @ self.mean - 2.0 * target @ self.mean - (pushed * solved[:, :, -1:]).sum()
        )
        own = variance[variance > 0.0]
        prior = 0.5 * float((np.log(own) - own).sum())
        self.log_likelihood = prior - 0.5 * float(np.linalg.slogdet(inner)[1].sum() + quadratic)

    def at(self, variance: Array) -> "_Fit":
        """The same tracks with other variances (p,)."""
        return _Fit(self.information, self.moved, self.about, variance)

    @property
    def updated(self) -> Array:
        """(p,) the variances after one step: the pulls as large as they are, against as large as they should be."""
        pulls, expected = self._slopes
        down = expected + 1.0
        return np.where(
            self.variance > 0.0, (1.0 + np.sqrt(1.0 + 4.0 * down * pulls * self.variance**2)) / (2.0 * down), 0.0
        )

    @property
    def scored(self) -> Array:
        """(p,) the variances after a step of Fisher scoring."""
        pulls, expected = self._slopes
        free, found = self.variance > 0.0, self.variance.copy()
        own = found[free]
        curvature = self.about.paired(self._marginal**2)[np.ix_(free, free)] + np.diag(own**-2)
        step = np.linalg.solve(curvature, (pulls - expected)[free] + 1.0 / own - 1.0)
        found[free] = np.maximum(own + step, own / LARGEST_FALL)
        return found

    @cached_property
    def _slopes(self) -> tuple[Array, Array]:
        """(p,) twice the slope of the log likelihood by each variance: squared pulls, less what they should be."""
        about = self.about
        pulls = about.summed((self._vector - (self._marginal @ self.mean[about.numbers][..., None])[..., 0]) ** 2)
        return pulls, about.summed(np.einsum("ikk->ik", self._marginal))


@dataclass(frozen=True)
class _Means:
    """The p means; numbers (n, k) say which ones each track's coefficients are draws about; bounds of the means."""

    numbers: Index
    size: int
    bounds: tuple[Array, Array]

    def summed(self, values: Array) -> Array:
        """(p,) sums of values (n, k) by mean."""
        return np.asarray(np.bincount(self.numbers.ravel(), values.ravel(), minlength=self.size), dtype=np.float64)

    def precision(self, marginal: Array) -> Array:
        """(p, p) of the means, their prior included. Args: marginal: (n, k, k) information of each track."""
        found = self.paired(marginal)
        return (found + found.T) / 2.0 + np.eye(self.size)

    def paired(self, values: Array) -> Array:
        """(p, p) sums of values (n, k, k) by pairs of means."""
        places = (self.numbers[:, :, None] * self.size + self.numbers[:, None, :]).ravel()
        found = np.bincount(places, values.ravel(), minlength=self.size**2)
        return np.asarray(found, dtype=np.float64).reshape(self.size, self.size)

    def best(self, precision: Array, target: Array) -> Array:
        """(p,) the best means within their bounds."""
        free = np.linalg.solve(precision, target)
        if ((self.bounds[0] <= free) & (free <= self.bounds[1])).all():
            return np.asarray(free)
        root = np.linalg.cholesky(precision).T
        return np.asarray(lsq_linear(root, np.linalg.solve(root.T, target), self.bounds, method="bvls").x)
