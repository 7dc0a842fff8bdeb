"""Widens the covariance of a stream's newest state where its sample may have followed a hit.

A hit shows in the samples after it, and the events name it with the second or third of them. Until then the newest
state is that of the flight before. A sample that contradicts this flight is an outlier, or the ball was struck since
the last one that agreed; the probability of that is weighed with the segmentation's own priors.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.estimation.settings import Settings
from ballfg.state import POSITION, STANDARD_GRAVITY, STATE_DIM, VELOCITY, Z

AGREES: Final = 7.814728
"""Squared whitened distance in three dimensions below which a sample agrees with a flight: 95 % of good ones do."""
LEAST_CHANCE: Final = 0.01
"""Chance of a hit below which it is neglected: intervals of 99 % may miss it."""


@dataclass
class HitDoubt:
    """Follows the samples of a stream that contradict its flight.

    Args:
        settings: noise and priors.  priors: rate of hits, share and spread of outliers.
        contradicting: number of consecutive samples.  elapsed: s, since the last sample that agreed.
    """

    settings: Settings
    priors: SegmentationSettings
    contradicting: int = 0
    elapsed: float = 0.0

    def reset(self) -> None:
        """Begins anew, with a sample that agrees or follows a known event."""
        self.contradicting, self.elapsed = 0, 0.0

    def widened(
        self, before: tuple[Array, Array], dt: float, position: Array, noise: Array, newest: tuple[Array, Array]
    ) -> Array:
        """(d, d) covariance of the newest state and coefficients about their means, with that of a struck ball.

        Args:
            before: mean and covariance a sample ago, which begin with a state.  dt: s since then.
            position: (3,) m, measured.  noise: (3,) m, its standard deviation.
            newest: mean (d,) and covariance (d, d) after the sample.
        """
        mean, covariance = newest
        off, spread = _innovation(before, dt, position, noise)
        if off @ np.linalg.solve(spread, off) < AGREES:
            self.reset()
            return covariance
        self.contradicting, self.elapsed = self.contradicting + 1, self.elapsed + dt
        chance = self._chance(off, spread)
        if not chance > LEAST_CHANCE:
            return covariance
        struck, own = np.zeros_like(covariance), slice(STATE_DIM)
        jump = np.zeros(STATE_DIM)
        jump[POSITION] = position - mean[POSITION]
        sigmas = np.concatenate((noise, np.full(3, self.settings.velocity_prior), np.full(3, self.settings.spin_prior)))
        struck[own, own] = np.diag(sigmas**2) + np.outer(jump, jump)
        struck[STATE_DIM:, STATE_DIM:] = covariance[STATE_DIM:, STATE_DIM:]
        return (1.0 - chance) * covariance + chance * struck

    def _chance(self, off: Array, spread: Array) -> float:
        """Probability that the ball was struck since the last sample that agreed; off (3,), spread (3, 3)."""
        priors, k = self.priors, self.contradicting
        struck = -math.expm1(-priors.hit_rate * self.elapsed)
        way = self.settings.velocity_prior * self.elapsed
        logs = np.array(
            [
                math.log(struck) + _log_density(off, spread + way**2 / 3.0 * np.eye(3)),  # at any moment since then
                k * math.log(priors.outlier_share) + _log_density(off, spread + priors.outlier_spread**2 * np.eye(3)),
                _log_density(off, spread),
            ]
        )
        shares = np.exp(logs - logs.max())
        return float(shares[0] / shares.sum())


def _innovation(before: tuple[Array, Array], dt: float, position: Array, noise: Array) -> tuple[Array, Array]:
    """(3,) m, a measured position less that of a flight over dt s, and its covariance (3, 3)."""
    mean, P = before
    ahead = mean[POSITION] + dt * mean[VELOCITY]
    ahead[Z] -= 0.5 * STANDARD_GRAVITY * dt**2
    both = P[POSITION, VELOCITY]
    spread = P[POSITION, POSITION] + dt * (both + both.T) + dt**2 * P[VELOCITY, VELOCITY]
    spread.flat[:: len(noise) + 1] += noise**2
    return position - ahead, spread


def _log_density(off: Array, covariance: Array) -> float:
    """Logarithm of a normal density of three numbers, up to a constant."""
    return float(-0.5 * (off @ np.linalg.solve(covariance, off) + np.linalg.slogdet(covariance)[1]))
