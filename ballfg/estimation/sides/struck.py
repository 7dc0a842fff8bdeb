"""Widens the covariance of a stream's newest state where its sample may have followed a hit, or the end of a rest.

A hit shows in the samples after it, and the events name it with the second or third of them. Until then the newest
state is that of the flight before. A sample that contradicts this flight is an outlier, or the ball was struck since
the last one that agreed; the probability of that is weighed with the segmentation's own priors.

A ball that rolled over an end of its table falls unnoticed for longer: 2 mm in 20 ms. So a hypothesis of such a ball is
followed from sample to sample.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.motion.limits import LEAST_SIGMA
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.estimation.settings import Settings
from ballfg.estimation.sides.gaussians import GaussianMixture, log_density
from ballfg.estimation.sides.hypotheses import HypothesisModel
from ballfg.estimation.sides.monitor import LEAST_SAMPLES, LEAST_TIME
from ballfg.factors.linear.definite import definite, variances_positive
from ballfg.state import POSITION, STANDARD_GRAVITY, STATE_DIM, VZ

AGREES: Final = 7.814728
"""Squared whitened distance in three dimensions below which a sample agrees with a flight: 95 % of good ones do."""
LEAST_CHANCE: Final = 0.01
"""Chance of a hit below which it is neglected: intervals of 99 % may miss it."""
TINY: Final = 1e-300  # Least probability, whose logarithm is finite


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


@dataclass
class RestDoubt:
    """Follows a ball that may have left the surface on which the events have it at rest.

    Args:
        priors: rate of leaving, spread of the vertical speed then, share and spread of outliers.
        left: a ball in the air; its weight is relative to that of the ball at rest.
        named, elapsed: number of samples and s since the events have it in the air.
    """

    priors: SegmentationSettings
    left: GaussianMixture | None = None
    named: int = 0
    elapsed: float = 0.0

    def reset(self) -> None:
        """Begins anew, with a ball in the air."""
        self.left = None

    def flown(self, model: HypothesisModel, dt: float, measured: tuple[Array, Array]) -> tuple[Array, Array] | None:
        """Mean (d,) and covariance (d, d) of a ball that has left, while the events take its last moments for a rest.

        Args: as `step`.
        """
        self.named, self.elapsed = self.named + 1, self.elapsed + dt
        over = self.named > LEAST_SAMPLES and self.elapsed > LEAST_TIME
        if over or self.left is None or self.left.log_weight <= 0.0:  # it did not look so
            self.reset()
            return None
        left = weighed(model, model.predict_flight(self.left, dt), measured, self.priors).merged()
        self.left = replace(left, log_weights=np.ones(1))
        return self.left.means[0], self.left.covariances[0]

    def step(
        self,
        model: HypothesisModel,
        before: tuple[Array, Array],
        dt: float,
        measured: tuple[Array, Array],
        level: float,
    ) -> tuple[float, Array, Array] | None:
        """Follows the ball to the next sample.

        Args:
            before: mean and covariance of state, coefficients and bias of the ball at rest a sample ago.
            dt: s since then.  measured: (3,) m, position and standard deviation of its white error.
            level: m, height of the surface.
        Returns: probability that the ball has left it; mean (d,) and covariance (d, d) if it has. None: hardly any.
        """
        self.named, self.elapsed = 0, 0.0
        resting = GaussianMixture.single(*before)
        stays = model.predict_rest(resting, dt, level)
        leaves = model.predict_flight(model.predict_rest(resting, 0.5 * dt, level), 0.5 * dt)
        late = STANDARD_GRAVITY * dt / math.sqrt(12.0)  # m/s, as it may leave at any moment of the interval
        leaves.covariances[0, VZ, VZ] += self.priors.leave_speed**2 + late**2
        chance = 1.0 - math.exp(-self.priors.hit_rate * dt) * _share_kept(resting, stays, model.world)
        parts = [replace(leaves, log_weights=np.log([max(chance, TINY)]))]
        if self.left is not None:
            parts.append(model.predict_flight(self.left, dt))
        left = weighed(model, GaussianMixture.concatenated(parts), measured, self.priors).merged()
        resting = replace(stays, log_weights=np.log([max(1.0 - chance, TINY)]))
        kept = weighed(model, resting, measured, self.priors)
        self.left = left.divided(kept.log_weight)
        share = float(np.exp(left.log_weight - np.logaddexp(left.log_weight, kept.log_weight)))
        return (share, left.means[0], left.covariances[0]) if share > LEAST_CHANCE else None


def weighed(
    model: HypothesisModel, balls: GaussianMixture, measured: tuple[Array, Array], priors: SegmentationSettings
) -> GaussianMixture:
    """Balls after a measured position, which may be an outlier.

    Args: measured: (3,) m, position and standard deviation of its white error.  priors: of outliers.
    """
    off, noise, H = model.innovations(balls, *measured)
    good, _ = balls.updated(off, noise, H)
    wide = priors.outlier_spread**2 * np.eye(3)
    lost = [
        log_density(one, H @ spread @ H.T + own + wide)
        for one, spread, own in zip(off, balls.covariances, noise, strict=True)
    ]
    outliers = replace(balls, log_weights=balls.log_weights + lost)
    share = priors.outlier_share
    return GaussianMixture.concatenated([good.divided(-math.log1p(-share)), outliers.divided(-math.log(share))])


def beside(one: tuple[Array, Array], other: tuple[Array, Array], chance: float) -> tuple[tuple[Array, Array], Array]:
    """The more probable one of two Gaussians, and the second moment (d, d) of both about its mean.

    Args: one, other: means (d,) and covariances (d, d).  chance: of the other.
    """
    near, far, chance = (one, other, chance) if chance <= 0.5 else (other, one, 1.0 - chance)
    jump = far[0] - near[0]
    return near, np.asarray((1.0 - chance) * near[1] + chance * (far[1] + np.outer(jump, jump)))


def _share_kept(earlier: GaussianMixture, later: GaussianMixture, world: Array) -> float:
    """Share of balls on the table that have not passed its ends from one moment to the next."""
    before, after = (share_within(balls.means[0], balls.covariances[0], world) for balls in (earlier, later))
    return min(after / before, 1.0) if before > TINY else 0.0


def share_within(mean: Array, covariance: Array, world: Array) -> float:
    """Share of balls (d,), (d, d) whose centres lie within the table's ends."""
    share = 1.0
    for axis in range(2):
        spread = np.sqrt(covariance[axis, axis] + world[7 + 2 * axis : 9 + 2 * axis] ** 2)
        low, high = (world[3 + 2 * axis : 5 + 2 * axis] - mean[axis]) / np.maximum(spread, LEAST_SIGMA)
        share *= 0.5 * (math.erf(high / math.sqrt(2.0)) - math.erf(low / math.sqrt(2.0)))
    return share
