"""Gaussians of one ball with their weights: how measurements and a surface change them, and what they are together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, logsumexp

from ballfg.arrays import Array
from ballfg.estimation.observations.innovation import FilterInnovation
from ballfg.factors.batch import FactorBatch

LEAST_SPREAD = 1e-9
"""m, least standard deviation of a gap."""


@dataclass(frozen=True)
class Mixture:
    """Gaussians over the state of a ball, the model's coefficients and the tracker's bias, in this order.

    Attributes:
        logs: (n,) logarithms of the weights, all up to one factor.
        means: (n, d).
        covariances: (n, d, d).
    """

    logs: Array
    means: Array
    covariances: Array

    @classmethod
    def one(cls, mean: Array, covariance: Array) -> Mixture:
        """A single Gaussian (d,) and (d, d) with the weight one."""
        return cls(np.zeros(1), mean[None], covariance[None])

    @staticmethod
    def joined(parts: list[Mixture]) -> Mixture:
        """All Gaussians of some mixtures."""
        return Mixture(*(np.concatenate([getattr(p, f) for p in parts]) for f in ("logs", "means", "covariances")))

    @property
    def log(self) -> float:
        """The logarithm of the whole weight."""
        return float(logsumexp(self.logs))

    def taken(self, rows: Array) -> Mixture:
        """Some of the Gaussians, by a mask (n,)."""
        return Mixture(self.logs[rows], self.means[rows], self.covariances[rows])

    def seen_at(self, position: Array, noise: Array, H: Array) -> tuple[Mixture, Array]:
        """After a measured position.

        Args: position: (3,) m.  noise: (n, 3, 3) m^2 for each Gaussian.  H: (3, d) of a measured position.
        Returns: the Gaussians, and the squared whitened innovation of each (n,).
        """
        miss = position - self.means @ H.T
        rows = H @ self.covariances
        spread = rows @ H.T + noise
        gain = np.linalg.solve(spread, rows).swapaxes(1, 2)
        square = (miss * np.linalg.solve(spread, miss[..., None])[..., 0]).sum(axis=1)
        logs = self.logs - 0.5 * (square + np.linalg.slogdet(spread)[1])
        rest = np.eye(H.shape[1]) - gain @ H
        covariances = rest @ self.covariances @ rest.swapaxes(1, 2) + gain @ noise @ gain.swapaxes(1, 2)
        return Mixture(logs, self.means + (gain @ miss[..., None])[..., 0], covariances), square

    def seen_by(self, factor: FactorBatch, biases: int) -> Mixture:
        """After another measurement, a batch of one factor; its robust loss bounds what an outlier does.

        Args: biases: how many numbers at the end of the state are biases, which the factor does not look at.
        """
        logs, means, covariances = self.logs.copy(), self.means.copy(), self.covariances.copy()
        for i, (mean, covariance) in enumerate(zip(self.means, self.covariances, strict=True)):
            found = FilterInnovation.of(factor, mean, covariance, biases)
            spread = found.spread + found.R
            gain = np.linalg.solve(spread, found.H @ covariance).T
            square = float(found.residual @ np.linalg.solve(spread, found.residual))
            logs[i] -= 0.5 * (square + np.linalg.slogdet(spread)[1])
            means[i] = mean - gain @ found.residual
            rest = np.eye(len(mean)) - gain @ found.H
            covariances[i] = rest @ covariance @ rest.T + gain @ found.R @ gain.T
        return Mixture(logs, means, covariances)

    def above(self, gaps: Array, gradients: Array) -> Mixture:
        """The part above a surface: each Gaussian is cut where the gap is zero, and weighed by what is left of it.

        Args: gaps: (n,) m, between ball and surface at the means.  gradients: (n, d) of the gap.
        """
        along = (self.covariances @ gradients[..., None])[..., 0]
        sigma = np.sqrt(np.maximum((gradients * along).sum(axis=1), LEAST_SPREAD**2))
        along, cut = along / sigma[:, None], -gaps / sigma
        left = log_ndtr(-cut)
        shift = np.exp(-0.5 * cut**2 - 0.5 * np.log(2.0 * np.pi) - left)  # mean of a standard normal above the cut
        thinner = shift * (cut - shift)
        means = self.means + shift[:, None] * along
        covariances = self.covariances + thinner[:, None, None] * along[:, :, None] * along[:, None, :]
        return Mixture(self.logs + left, means, covariances)

    def merged(self) -> Mixture:
        """One Gaussian with the mean, the covariance and the weight of all together."""
        log = self.log
        shares = np.exp(self.logs - log)
        mean = shares @ self.means
        apart = self.means - mean
        covariance = np.einsum("n,nij->ij", shares, self.covariances) + (shares * apart.T) @ apart
        return Mixture(np.array([log]), mean[None], 0.5 * (covariance + covariance.T)[None])

    def scaled(self, log: float) -> Mixture:
        """The same with all weights divided by one of logarithm `log`."""
        return replace(self, logs=self.logs - log)
