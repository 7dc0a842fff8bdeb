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
from ballfg.estimation.sides.gaussians import GaussianMixture, log_density
from ballfg.estimation.sides.hypotheses import HypothesisModel
from ballfg.factors.linear.definite import definite, variances_positive
from ballfg.state import POSITION, STATE_DIM

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
        self,
        model: HypothesisModel,
        before: tuple[Array, Array],
        dt: float,
        measured: tuple[Array, Array, Array],
        newest: tuple[Array, Array],
    ) -> Array:
        """(d, d) covariance of the newest state and coefficients about their means, with that of a struck ball.

        Args:
            model: of the ball and its measurement.
            before: mean and covariance of state, coefficients and bias a sample ago.  dt: s since then.
            measured: (3,) m, position, and standard deviations (3,) m of its white error and of its whole one.
            newest: mean (d,) and covariance (d, d) after the sample.
        """
        position, white, whole = measured
        mean, covariance = newest
        flown = model.predict_flight(GaussianMixture.single(*before), dt)
        (off,), noise, H = model.innovations(flown, position, white)
        spread = H @ flown.covariances[0] @ H.T + noise[0]
        if not variances_positive(spread) or off @ np.linalg.solve(spread := definite(spread), off) < AGREES:
            self.reset()
            return covariance
        self.contradicting, self.elapsed = self.contradicting + 1, self.elapsed + dt
        chance = self._chance(off, spread)
        if not chance > LEAST_CHANCE:
            return covariance
        struck, own = np.zeros_like(covariance), slice(STATE_DIM)
        jump = np.zeros(STATE_DIM)
        jump[POSITION] = position - mean[POSITION]
        sigmas = np.concatenate((whole, np.full(3, self.settings.velocity_prior), np.full(3, self.settings.spin_prior)))
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
                math.log(struck) + log_density(off, spread + way**2 / 3.0 * np.eye(3)),  # at any moment since then
                k * math.log(priors.outlier_share) + log_density(off, spread + priors.outlier_spread**2 * np.eye(3)),
                log_density(off, spread),
            ]
        )
        shares = np.exp(logs - logs.max())
        return float(shares[0] / shares.sum())
