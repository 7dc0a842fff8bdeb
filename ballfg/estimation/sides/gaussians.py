"""Updates, truncates and merges Gaussian mixtures over the state of one ball."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.estimation.observations.innovation import FilterInnovation
from ballfg.factors.batch import FactorBatch

LEAST_SPREAD = 1e-9
"""m, least standard deviation of a gap."""
FAR_TAIL = 20.0
"""Standard deviations from which on the share of a normal comes from a series, with an error of 1e-16."""
TERMS = 10
"""Of that series."""


@dataclass(frozen=True)
class GaussianMixture:
    """Gaussians over the state of a ball, the model's coefficients and the tracker's bias, in this order.

    Attributes: log_weights: (n,), not normalised.  means: (n, d).  covariances: (n, d, d).
    """

    log_weights: Array
    means: Array
    covariances: Array

    @classmethod
    def single(cls, mean: Array, covariance: Array) -> "GaussianMixture":
        """One Gaussian (d,) and (d, d) with the weight one."""
        return cls(np.zeros(1), mean[None], covariance[None])

    @staticmethod
    def concatenated(parts: "Sequence[GaussianMixture]") -> "GaussianMixture":
        """All Gaussians of several mixtures."""
        fields = ("log_weights", "means", "covariances")
        return GaussianMixture(*(np.concatenate([getattr(part, field) for part in parts]) for field in fields))

    def __len__(self) -> int:
        return len(self.log_weights)

    @property
    def log_weight(self) -> float:
        """The logarithm of the sum of all weights; -inf without Gaussians."""
        largest = float(self.log_weights.max(initial=-np.inf))
        return largest if largest == -np.inf else largest + float(np.log(np.exp(self.log_weights - largest).sum()))

    def selected(self, rows: NDArray[np.bool_]) -> "GaussianMixture":
        """A part of the Gaussians, by a mask (n,)."""
        return GaussianMixture(self.log_weights[rows], self.means[rows], self.covariances[rows])

    def updated(self, innovation: Array, noise: Array, H: Array) -> "tuple[GaussianMixture, Array]":
        """The Kalman update, and squared whitened innovations (n,); weights gain the likelihood.

        Args:
            innovation: (n, r) measured less predicted, for each Gaussian.
            noise: (n, r, r) in the squares of their unit.
            H: (r, d) or (n, r, d) of what is measured.
        """
        rows = H @ self.covariances
        spread = rows @ H.swapaxes(-1, -2) + noise
        gain = np.linalg.solve(spread, rows).swapaxes(1, 2)
        squares = (innovation * np.linalg.solve(spread, innovation[..., None])[..., 0]).sum(axis=1)
        log_weights = self.log_weights - 0.5 * (squares + np.linalg.slogdet(spread)[1])
        rest = np.eye(H.shape[-1]) - gain @ H
        covariances = rest @ self.covariances @ rest.swapaxes(1, 2) + gain @ noise @ gain.swapaxes(1, 2)
        means = self.means + (gain @ innovation[..., None])[..., 0]
        return GaussianMixture(log_weights, means, covariances), squares

    def updated_by_factor(self, factor: FactorBatch, biases: int) -> "GaussianMixture":
        """The same update with a batch of one factor, which does not see the `biases` at the state's end."""
        found = [FilterInnovation.of(factor, *one, biases) for one in zip(self.means, self.covariances, strict=True)]
        residuals, noise, H = (np.stack([getattr(one, name) for one in found]) for name in ("residual", "R", "H"))
        return self.updated(-residuals, noise, H)[0]

    def truncated(self, gaps: Array, gradients: Array) -> "GaussianMixture":
        """The part above a surface, from gaps (n,) m and gradients (n, d); weighted by the remaining shares."""
        along = (self.covariances @ gradients[..., None])[..., 0]
        sigma = np.sqrt(np.maximum((gradients * along).sum(axis=1), LEAST_SPREAD**2))
        along, cut = along / sigma[:, None], -gaps / sigma
        log_share = np.array([_log_share_above(one) for one in cut.tolist()])
        shift = np.exp(-0.5 * cut**2 - 0.5 * np.log(2.0 * np.pi) - log_share)  # mean of a standard normal above the cut
        narrowing = shift * (cut - shift)
        means = self.means + shift[:, None] * along
        covariances = self.covariances + narrowing[:, None, None] * along[:, :, None] * along[:, None, :]
        return GaussianMixture(self.log_weights + log_share, means, covariances)

    def merged(self) -> "GaussianMixture":
        """One Gaussian with the mean, the covariance and the weight of the whole mixture."""
        log_weight = self.log_weight
        shares = np.exp(self.log_weights - log_weight)
        mean = shares @ self.means
        apart = self.means - mean
        covariance = np.einsum("n,nij->ij", shares, self.covariances) + (shares * apart.T) @ apart
        return GaussianMixture(np.array([log_weight]), mean[None], 0.5 * (covariance + covariance.T)[None])

    def divided(self, log_weight: float) -> "GaussianMixture":
        """The mixture with all weights divided by one, given by its logarithm."""
        return replace(self, log_weights=self.log_weights - log_weight)


def log_density(off: Array, covariance: Array) -> float:
    """Logarithm of a normal density (d,) away from its mean, without the constant that depends on d alone."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, off)
    return float(-0.5 * white @ white - np.log(np.diagonal(root)).sum())


def _log_share_above(cut: float) -> float:
    """Logarithm of the share of a standard normal above a cut; scipy's takes a tenth of a second to import.

    Source of the series: M. Abramowitz, I. A. Stegun, "Handbook of Mathematical Functions", 1964, 26.2.12.
    """
    if cut < 0.0:
        return math.log1p(-0.5 * math.erfc(-cut / math.sqrt(2.0)))
    if cut < FAR_TAIL:
        return math.log(0.5 * math.erfc(cut / math.sqrt(2.0)))
    series = term = 1.0
    for k in range(1, TERMS):
        term *= -(2 * k - 1) / (cut * cut)
        series += term
    return -0.5 * cut * cut - math.log(cut * math.sqrt(2.0 * math.pi)) + math.log(series)
