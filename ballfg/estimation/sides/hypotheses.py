"""Follows two hypotheses of a ball near a surface, bounced and not yet bounced, weighted by the measurements.

A Kalman filter follows each of them from a sample before the bounce. A bounce somewhat before or after a stamp is a
smooth continuation of the motion (docs/derivations/contact.md). So one Gaussian per hypothesis is enough for any time
of the contact; it is truncated where the ball would be below the surface. Friction is not smooth: it has a kink between
sliding and rolling. So a bounce is computed for nine narrower Gaussians of the spin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.arrays import Array, plain
from ballfg.dynamics.compiled.beliefs.edges import height_below
from ballfg.dynamics.compiled.beliefs.mixture import FAR
from ballfg.dynamics.compiled.motion import world_of
from ballfg.dynamics.motion.arrays import PreparedMotion, roll_jacobian
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.observation import Observation
from ballfg.estimation.settings import Settings, stamp_covariance
from ballfg.estimation.sides.gaussians import GaussianMixture
from ballfg.factors.batch import FactorBatch
from ballfg.factors.correlated_noise import bias_step
from ballfg.factors.dynamics import model_width
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, STATE_DIM, VELOCITY, VZ, Z
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

MOST_OFFSET: Final = 0.05
"""m. Upper bound on the rise of a surface by coefficients and slopes."""
WIDE_VELOCITY: Final = 1.0
"""m/s. With a less certain velocity, as at the start of a flight, no sample is certainly before a contact."""
SLOWEST: Final = 0.3
"""m/s. A ball that falls more slowly makes several small hops between samples, or comes to rest: two hypotheses do not
describe it."""
SHORTEST_HOP: Final = 2.0 * SLOWEST / STANDARD_GRAVITY
"""s. In a shorter interval no ball that two hypotheses describe bounces twice."""
STEEPEST_FALL: Final = 2.0 * STANDARD_GRAVITY
"""m/s^2, a bound on the downward acceleration; topspin adds to the weight."""
NODE_SHARE: Final = 2.0 / 3.0
"""Share of the spin's variance that lies between the nodes; the rest is within each. Nodes without spread of their own
leave gaps: where a sample shows the bounce better than the nodes resolve it, one of them would be taken as certain.
0.4 to 0.8 do alike on 300 simulated bounces; 500 others judge (`tests.estimation.both_sides`, seed 7)."""
NODES: Final = NODE_SHARE**0.5 * np.array([-(3.0**0.5), 0.0, 3.0**0.5])
"""Nodes of a Gauss-Hermite quadrature of order three for that share, in standard deviations."""
NODE_WEIGHTS: Final = np.array([1.0, 4.0, 1.0]) / 6.0
"""Weights of these nodes."""
GRID: Final = np.stack(np.meshgrid(NODES, NODES), axis=-1).reshape(-1, 2)
GRID_LOG_WEIGHTS: Final = np.log(np.outer(NODE_WEIGHTS, NODE_WEIGHTS)).ravel()
"""The same in two directions."""
HORIZONTAL_SPIN: Final = slice(SPIN.start, SPIN.start + 2)
"""The components of the spin that friction at a level surface depends on."""


@dataclass(frozen=True)
class SampleMeasurement:
    """The measurements at one stamp.

    Attributes:
        position: (3,) m; None if it was not measured or was rejected.  sigma: (3,) m, of its white error.
        factors: all other measurements, batches of one factor each.
    """

    position: Array | None = None
    sigma: Array = field(default_factory=lambda: np.zeros(3))
    factors: Sequence[FactorBatch] = ()


def measured_at(
    track: Track, sigma: Array, batches: Mapping[Observation, FactorBatch], sample: int
) -> SampleMeasurement:
    """The measurements at a sample of a track, given sigmas (n, 3) m and the factors of other observations.

    A reading between stamps may lie on the other side of the contact, so that it is left out.
    """
    rows = [(batch, row) for one, batch in batches.items() for row in one.filter_rows(sample, 0.0, 0.0)]
    factors = [batch.select(np.array([row])) for batch, row in rows]
    return SampleMeasurement(track.positions[sample], sigma[sample], factors)


@dataclass(frozen=True)
class HypothesisModel:
    """Motion and measurement of a ball: state, estimated coefficients, and 0 or 3 biases of the tracker."""

    ball: BallModel
    surfaces: Surfaces
    settings: Settings
    biases: int = 0

    @property
    def width(self) -> int:
        """Number of values that move with the ball: state and coefficients."""
        return STATE_DIM + model_width(self.ball)

    @cached_property
    def motion(self) -> PreparedMotion:
        """The ball's."""
        return PreparedMotion(self.ball, self.width)

    @cached_property
    def world(self) -> Array:
        """(11,) the surfaces, as machine code takes them."""
        return world_of(self.surfaces, self.ball.radius)

    def level(self, mean: Array) -> float:
        """m, height of the surface below a ball (d,); -inf where there is none."""
        (above,), _ = self.motion.gaps(mean[None, : self.width], 0.0)
        return float(height_below(plain(mean), mean[Z] - above - self.ball.radius, self.world))

    def gaps(self, means: Array, level: float) -> tuple[Array, Array]:
        """(n,) m between balls (n, d) and a surface, and its gradients (n, d)."""
        gradients = np.zeros(means.shape)
        gaps, gradients[:, : self.width] = self.motion.gaps(means[:, : self.width], level)
        return gaps, gradients

    def may_touch(self, mean: Array, covariance: Array, dt: float, *, told: bool = False) -> bool:
        """True if a ball may come down to a surface within dt s; most are far: a coarse bound is first.

        Args: told: True if the estimator says that it does, however far it is.
        """
        way = mean[VZ] * dt - 0.5 * STEEPEST_FALL * dt**2
        reach = MOST_OFFSET + FAR * (np.sqrt(covariance[Z, Z]) + dt * np.sqrt(covariance[VZ, VZ]))
        lowest = mean[Z] - self.ball.radius + way - reach
        if not told and all(lowest > height for height in self.surfaces.heights()):
            return False
        level = self.level(mean)
        if not np.isfinite(level) or np.trace(covariance[VELOCITY, VELOCITY]) > WIDE_VELOCITY**2:
            return False
        if lowest > level and not told:
            return False
        (gap,), (gradient,) = self.gaps(mean[None], level)
        falling = min(float(mean[VZ]), 0.0)
        if gap < 0.0 or falling**2 + 2.0 * STANDARD_GRAVITY * gap < SLOWEST**2:
            return False
        gradient[VZ] += dt
        return told or bool(gap + way < FAR * np.sqrt(gradient @ covariance @ gradient))

    def predict_flight(self, balls: GaussianMixture, dt: float) -> GaussianMixture:
        """Balls after dt s of free flight, without surfaces."""
        after, jacobian = self.motion.fly(balls.means[:, : self.width], dt)
        return self._predicted(balls, after, jacobian, self.settings.process.flight(np.array([dt])), dt)

    def predict_rest(self, balls: GaussianMixture, dt: float, level: float) -> GaussianMixture:
        """Balls after dt s on the surface at a level (m), as if it had no ends."""
        spans, levels = np.full(len(balls), dt), np.full(len(balls), level)
        after, jacobian = roll_jacobian(self.ball, balls.means[:, : self.width], spans, levels)
        noise = self.settings.process.flight(np.array([dt]))
        return self._predicted(balls, after, jacobian, noise, dt)

    def predict_bounce(self, balls: GaussianMixture, dt: float, level: float) -> GaussianMixture:
        """Balls after dt s with one bounce on the way, without those that never come down."""
        after, times, jacobian = self.motion.bounce(balls.means[:, : self.width], dt, level)
        found = np.asarray(np.isfinite(after).all(axis=1))
        process, spans = self.settings.process, np.full(int(found.sum()), dt)
        noise = process.flight(np.array([dt])) + process.contact(spans, times[found])
        return self._predicted(balls.selected(found), after[found], jacobian[found], noise, dt)

    def predict_bounces(self, balls: GaussianMixture, dt: float, level: float) -> GaussianMixture:
        """Balls after dt s with one bounce on the way, and with two where they come down again by then."""
        once = self.predict_bounce(balls, dt, level)
        if dt < SHORTEST_HOP or not len(once):
            return once
        last = once.merged()
        (gap,), (gradient,) = self.gaps(last.means, level)
        since = -float(last.means[0, VZ]) / STANDARD_GRAVITY  # s since the ball was highest
        if not 0.0 < since < dt or gap > FAR * np.sqrt(gradient @ last.covariances[0] @ gradient):
            return once
        between = self.predict_bounce(balls, dt - since, level)
        return GaussianMixture.concatenated([once, self.predict_bounce(between, since, level)])

    def _predicted(
        self, balls: GaussianMixture, after: Array, jacobian: Array, noise: Array, dt: float
    ) -> GaussianMixture:
        w, d = self.width, balls.means.shape[1]
        F, Q, means = np.zeros((len(after), d, d)), np.zeros((len(after), d, d)), balls.means.copy()
        F[:, :w, :w], Q[:, :STATE_DIM, :STATE_DIM], means[:, :w] = jacobian, noise, after
        if self.biases:
            sigmas = self.settings.bias_sigmas[: self.biases]
            (decay,), (renewed,) = bias_step(np.array([dt]), sigmas, self.settings.memory_time)
            last = np.arange(w, d)
            means[:, w:] *= decay
            F[:, last, last], Q[:, last, last] = decay, renewed**2
        return GaussianMixture(balls.log_weights, means, F @ balls.covariances @ F.swapaxes(1, 2) + Q)

    def update(self, balls: GaussianMixture, measured: SampleMeasurement) -> tuple[GaussianMixture, float]:
        """Balls after a measurement, and the least squared whitened innovation of the position."""
        nearest = 0.0
        if measured.position is not None:
            balls, squares = balls.updated(*self.innovations(balls, measured.position, measured.sigma))
            nearest = float(squares.min())
        for factor in measured.factors:
            balls = balls.updated_by_factor(factor, self.biases)
        return balls, nearest

    def innovations(self, balls: GaussianMixture, position: Array, sigma: Array) -> tuple[Array, Array, Array]:
        """A measured position (3,) less those expected of balls (n, 3), its noise (n, 3, 3), and H (3, d).

        Args: sigma: (3,) m, of its white error.
        """
        H = np.zeros((3, balls.means.shape[1]))
        H[:, POSITION], H[:, self.width :] = np.eye(3), np.eye(3)[:, : self.biases]
        noise = np.diag(sigma**2) + stamp_covariance(self.settings, balls.means[:, VELOCITY])
        return position - balls.means @ H.T, noise, H


def _at_nodes(balls: GaussianMixture) -> GaussianMixture:
    """One Gaussian as nine with the same moments, narrower in the horizontal spin.

    The nodes lie along the principal axes of that spin, so that a turned room has turned nodes.
    """
    (mean,), (covariance,) = balls.means, balls.covariances
    spin = covariance[HORIZONTAL_SPIN, HORIZONTAL_SPIN]
    slope = np.linalg.solve(spin, covariance[HORIZONTAL_SPIN]).T
    variances, axes = np.linalg.eigh(spin)
    means = mean + (GRID * np.sqrt(np.maximum(variances, 0.0))) @ axes.T @ slope.T
    conditional = covariance - NODE_SHARE * slope @ spin @ slope.T
    return GaussianMixture(
        balls.log_weights + GRID_LOG_WEIGHTS, means, np.repeat(conditional[None], len(means), axis=0)
    )


@dataclass(frozen=True)
class ContactHypotheses:
    """Two hypotheses of a ball: not yet bounced, and bounced.

    Attributes:
        model: of the ball.  flying: one Gaussian, without the surface.  bounced: Gaussians; none before the first step.
        level: m, height of the surface.
        nearest: squared whitened innovation of the last position under its best hypothesis.
    """

    model: HypothesisModel
    flying: GaussianMixture
    bounced: GaussianMixture
    level: float
    nearest: float = 0.0

    @classmethod
    def start(cls, model: HypothesisModel, mean: Array, covariance: Array) -> ContactHypotheses:
        """Hypotheses of a ball that has not bounced, with mean (d,) and covariance (d, d)."""
        flying = GaussianMixture.single(mean, covariance)
        return cls(model, flying, flying.selected(np.zeros(1, dtype=bool)), model.level(mean))

    def step(self, dt: float, measured: SampleMeasurement) -> ContactHypotheses:
        """The hypotheses dt s later, after a measurement."""
        weights = self._above.log_weights  # of the parts above the surface; the Gaussians stay whole
        still = replace(self.flying, log_weights=weights[:1])
        bouncing = self.model.predict_bounces(_at_nodes(still), dt, self.level)
        flying = [self.flying]
        if len(self.bounced):
            flying.append(replace(self.bounced, log_weights=weights[1:]).merged())
        flown = self.model.predict_flight(GaussianMixture.concatenated(flying), dt)
        first = np.arange(len(flown)) == 0
        bounced = GaussianMixture.concatenated([bouncing, flown.selected(~first)])
        return replace(self, flying=flown.selected(first), bounced=bounced).updated(measured)

    def updated(self, measured: SampleMeasurement) -> ContactHypotheses:
        """The hypotheses after a further measurement at the same stamp."""
        both, nearest = self.model.update(self._both, measured)
        first = np.arange(len(both)) == 0
        return replace(self, flying=both.selected(first), bounced=both.selected(~first), nearest=nearest)

    @property
    def _both(self) -> GaussianMixture:
        """The Gaussians of both hypotheses, the flying ball's first."""
        return GaussianMixture.concatenated([self.flying, self.bounced])

    @cached_property
    def sides(self) -> tuple[GaussianMixture, GaussianMixture]:
        """A Gaussian for each side of the contact, not yet bounced and bounced; the weights are probabilities."""
        first = np.arange(len(self._above)) == 0
        flying, bounced = self._above.selected(first), self._above.selected(~first)
        bounced = bounced.merged() if len(bounced) else flying.divided(np.inf)
        both = float(np.logaddexp(flying.log_weight, bounced.log_weight))
        return flying.divided(both), bounced.divided(both)

    @cached_property
    def _above(self) -> GaussianMixture:
        """The parts of all Gaussians above the surface, the flying ball's first."""
        both = self._both
        return both.truncated(*self.model.gaps(both.means, self.level))
