"""A ball that passes a surface: it flies on, or it has bounced, each with what the measurements say for it.

Both are followed by a Kalman filter from a sample on at which the ball had certainly not bounced. A bounce before or
after a stamp is a smooth continuation of the motion (docs/derivations/contact.md), so that on either side one Gaussian
is enough for the place of the contact; it is cut where the ball would be below the surface. What is not smooth is
friction, which has a kink between sliding and rolling: a bounce is computed at nine spins along the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.contact import fly_through_jacobian
from ballfg.dynamics.motion.integrate import fly_jacobian
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.settings import Settings, stamp_covariance
from ballfg.estimation.sides.mixture import Mixture
from ballfg.factors.batch import FactorBatch
from ballfg.factors.dynamics import model_width
from ballfg.factors.tracker import bias_step
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, STATE_DIM, VELOCITY, VZ, Z

NODES = np.array([(x, y) for x in (0.0, 3.0**0.5, -(3.0**0.5)) for y in (0.0, 3.0**0.5, -(3.0**0.5))])
"""Standard deviations along two axes, at which Gauss-Hermite quadrature of order three evaluates."""
NODE_LOGS = np.log([(2.0 / 3.0 if x == 0.0 else 1.0 / 6.0) * (2.0 / 3.0 if y == 0.0 else 1.0 / 6.0) for x, y in NODES])
ALONG = slice(SPIN.start, SPIN.start + 2)
"""The components of the spin that friction at a level surface changes."""

FAR: Final = 4.5
"""Standard deviations of the gap beyond which a ball has certainly not touched: one in 300,000."""
NEAR: Final = 0.1
"""m. What coefficients and slopes raise a surface by is less than that."""
WIDE_VELOCITY: Final = 1.0
"""m/s. A ball whose velocity is less well known, as at the start of a flight, is nowhere certainly above a surface."""
SLOWEST: Final = 0.3
"""m/s. A ball that falls more slowly makes several small hops between samples, or comes to rest: two sides do not
describe it."""
STEEPEST_FALL: Final = 2.0 * STANDARD_GRAVITY
"""m/s^2, a bound on how the ball falls: with topspin faster than by its weight."""


@dataclass(frozen=True)
class Seen:
    """What was measured at a stamp.

    Attributes:
        position: (3,) m; None where none was measured, or nobody believes it.
        sigma: (3,) m, of its white error.
        factors: everything else, batches of one factor each.
    """

    position: Array | None = None
    sigma: Array = field(default_factory=lambda: np.zeros(3))
    factors: Sequence[FactorBatch] = ()


@dataclass(frozen=True)
class Ways:
    """How a ball moves and is measured: what all its passages share.

    Attributes:
        model: the ball, with the coefficients that are estimated in columns behind the state.
        surfaces: that it may bounce on.
        settings: noise.
        biases: how many numbers of the tracker's bias stand behind state and coefficients: 0 or 3.
    """

    model: BallModel
    surfaces: Surfaces
    settings: Settings
    biases: int = 0

    @property
    def width(self) -> int:
        """How many numbers move with the ball: state and coefficients."""
        return STATE_DIM + model_width(self.model)

    def level(self, mean: Array) -> float:
        """m, height of the surface below a ball; -inf where there is none."""
        return float(self.surfaces.height_below(torch.from_numpy(mean[:STATE_DIM])))

    def gaps(self, means: Array, level: float) -> tuple[Array, Array]:
        """(n,) m between balls (n, d) and a surface, and its gradients (n, d)."""
        leaf = torch.from_numpy(np.ascontiguousarray(means[:, : self.width])).requires_grad_(True)
        with torch.enable_grad():
            gaps = self.model.gap(leaf, level)
            (slopes,) = torch.autograd.grad(gaps.sum(), leaf)
        gradients = np.zeros(means.shape)
        gradients[:, : self.width] = slopes.numpy()
        return gaps.detach().numpy(), gradients

    def may_touch(self, mean: Array, covariance: Array, dt: float) -> bool:
        """Whether the ball may come down to a surface within dt s; a bound first, for most samples are far from one."""
        level = self.level(mean)
        if not np.isfinite(level) or np.trace(covariance[VELOCITY, VELOCITY]) > WIDE_VELOCITY**2:
            return False
        way = mean[VZ] * dt - 0.5 * STEEPEST_FALL * dt**2
        height = mean[Z] - level - self.model.radius
        if height + way > NEAR + FAR * (np.sqrt(covariance[Z, Z]) + dt * np.sqrt(covariance[VZ, VZ])):
            return False
        (gap,), (gradient,) = self.gaps(mean[None], level)
        falling = -min(float(mean[VZ]), 0.0)
        if gap < 0.0 or falling**2 + 2.0 * STANDARD_GRAVITY * gap < SLOWEST**2:
            return False
        gradient[VZ] += dt
        return bool(gap + way < FAR * np.sqrt(gradient @ covariance @ gradient))

    def flown(self, balls: Mixture, dt: float) -> Mixture:
        """Balls after dt s of free flight, as if there were no surface."""
        start = torch.from_numpy(np.ascontiguousarray(balls.means[:, : self.width]))
        after, jacobian = fly_jacobian(self.model, start, torch.full((len(start),), dt, dtype=torch.float64))
        noise = np.repeat(self.settings.process.flight(np.array([dt])), len(start), axis=0)
        return self._carried(balls, after.numpy(), jacobian.numpy(), noise, dt)

    def bounced(self, balls: Mixture, dt: float, level: float) -> Mixture:
        """Balls after dt s with a bounce on the way, where there is one."""
        start = torch.from_numpy(np.ascontiguousarray(balls.means[:, : self.width]))
        durations = torch.full((len(start),), dt, dtype=torch.float64)
        after, times, jacobian = fly_through_jacobian(self.model, start, durations, (level,))
        found = torch.isfinite(after).all(dim=1).numpy()
        taus, spans = times[:, 0].numpy()[found], np.full(int(found.sum()), dt)
        noise = self.settings.process.flight(spans) + self.settings.process.contact(spans, taus)
        return self._carried(balls.taken(found), after.numpy()[found], jacobian.numpy()[found], noise, dt)

    def _carried(self, balls: Mixture, after: Array, jacobian: Array, noise: Array, dt: float) -> Mixture:
        w, n = self.width, len(after)
        F = np.zeros((n, balls.means.shape[1], balls.means.shape[1]))
        F[:, :w, :w] = jacobian
        means = balls.means.copy()
        means[:, :w] = after
        added = np.zeros(F.shape)
        added[:, :STATE_DIM, :STATE_DIM] = noise
        if self.biases:
            sigmas = self.settings.bias_sigmas[: self.biases]
            (decay,), (fresh,) = bias_step(np.array([dt]), sigmas, self.settings.memory_time)
            means[:, w:] *= decay
            last = np.arange(w, w + self.biases)
            F[:, last, last] = decay
            added[:, last, last] = fresh**2
        return Mixture(balls.logs, means, F @ balls.covariances @ F.swapaxes(1, 2) + added)

    def seen(self, balls: Mixture, seen: Seen) -> tuple[Mixture, float]:
        """Balls after what was measured, and the smallest squared whitened innovation of the position."""
        nearest = 0.0
        if seen.position is not None and len(balls.logs):
            H = np.zeros((3, balls.means.shape[1]))
            H[:, POSITION] = np.eye(3)
            H[:, self.width :] = np.eye(3)[:, : self.biases]
            noise = np.diag(seen.sigma**2) + stamp_covariance(self.settings, balls.means[:, VELOCITY])
            balls, squares = balls.seen_at(seen.position, noise, H)
            nearest = float(squares.min())
        for factor in seen.factors:
            balls = balls.seen_by(factor, self.biases)
        return balls, nearest

    def above(self, balls: Mixture, level: float) -> Mixture:
        """The part of balls that is above a surface."""
        return balls.above(*self.gaps(balls.means, level)) if len(balls.logs) else balls


def _at_nodes(balls: Mixture) -> Mixture:
    """One Gaussian as nine that are narrow in the spin along the surface."""
    (mean,), (covariance,) = balls.means, balls.covariances
    along = covariance[ALONG, ALONG]
    slope = np.linalg.solve(along, covariance[ALONG]).T  # of everything by the spin along the surface
    means = mean + NODES @ np.linalg.cholesky(along).T @ slope.T
    rest = covariance - slope @ along @ slope.T
    return Mixture(balls.logs + NODE_LOGS, means, np.repeat(rest[None], len(means), axis=0))


@dataclass(frozen=True)
class Passage:
    """What is known of a ball on either side of a contact.

    Attributes:
        ways: of the ball.
        flying: one Gaussian, as if there were no surface: of a ball that has not bounced, or not yet.
        risen: Gaussians of a ball that has; possibly none.
        level: m, height of the surface.
        nearest: squared whitened innovation of the last position, from where it is nearest.
    """

    ways: Ways
    flying: Mixture
    risen: Mixture
    level: float
    nearest: float = 0.0

    @classmethod
    def begun(cls, ways: Ways, mean: Array, covariance: Array) -> Passage:
        """Of a ball that has not bounced, with mean (d,) and covariance (d, d)."""
        flying = Mixture.one(mean, covariance)
        return cls(ways, flying, flying.taken(np.zeros(1, dtype=bool)), ways.level(mean))

    def after(self, dt: float, seen: Seen) -> Passage:
        """The same dt s later, with what was measured then."""
        ways = self.ways
        touching = ways.bounced(_at_nodes(self._weighed(self.flying)), dt, self.level)
        parts = [ways.flown(self._weighed(self.risen).merged(), dt), touching] if len(self.risen.logs) else [touching]
        return replace(self, flying=ways.flown(self.flying, dt), risen=Mixture.joined(parts)).measured(seen)

    def measured(self, seen: Seen) -> Passage:
        """With more that was measured at the present stamp."""
        flying, near = self.ways.seen(self.flying, seen)
        risen, other = self.ways.seen(self.risen, seen)
        nearest = min(near, other) if len(risen.logs) else near
        return replace(self, flying=flying, risen=risen, nearest=nearest)

    def sides(self) -> tuple[Mixture, Mixture]:
        """The ball that has not bounced and the one that has, one Gaussian each with its chance as the weight."""
        flying, risen = self.ways.above(self.flying, self.level), self.ways.above(self.risen, self.level)
        risen = risen.merged() if len(risen.logs) else replace(flying, logs=np.array([-np.inf]))
        log = np.logaddexp(flying.log, risen.log)
        return flying.scaled(log), risen.scaled(log)

    def _weighed(self, balls: Mixture) -> Mixture:
        """Balls that go on: whole, as the contact is a smooth place for them, with the weight of what is above it."""
        return replace(balls, logs=self.ways.above(balls, self.level).logs)
