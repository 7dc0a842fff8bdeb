"""Assigns positions to balls, by the region in which each ball may be at a stamp.

A ball may have flown on, bounced, or been hit. The first two are Gaussians about a parabola with drag; they are coarse
and cheap, since they decide only between centimetres and decimetres. The estimator weighs the sample itself.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import OnlineState
from ballfg.estimation.segmentation.physics import SegmentationPhysics

GATE = 30.0  # Squared Mahalanobis distance, 3 degrees of freedom: one good position in a million exceeds it
LONG_GATE = 16.0
"""The same after a silence of more than `HIT_TIME`, when the region of a ball is wide and may hold another ball."""
HIT_GATE = 9.0
"""The same for a ball that may have been hit: a position beyond three standard deviations begins another ball."""
HIT_TIME = 0.1  # s. After a longer silence a ball is searched only on its path: a hit could have moved it anywhere.
HIT_SPEED = 10.0  # m/s per axis, by which a hit moves the ball away from its path, apart from half of its own speed
SLACK = 4.0  # m/s^2. Spread of the acceleration beside gravity and drag: the Magnus force of a strong spin is 20.
SLIDE = 1.0  # m/s. Spread of the change of tangential velocity in a bounce.
FLOOR = 0.002  # m. Least noise of a position.
FAR = 1e6  # Cost of an impossible pair


@dataclass(frozen=True)
class Known:
    """The belief on a ball at a time."""

    time: float  # s
    mean: Array  # (6,) position m and velocity m/s
    covariance: Array  # (6, 6) of that, in the products of those units

    @classmethod
    def of(cls, state: OnlineState) -> "Known":
        """The belief of an estimated state in flight: a gate knows what a hit does."""
        joint = state.joint if state.struck is None else state.joint - state.struck
        return cls(state.time, state.mean[:6], joint[:6, :6])


class Gate:
    """Distances of positions from the regions of balls.

    Args:
        physics: of the ball.  heights: m, of the surfaces.  noise: (3,) m, of a position.
        jitter: s, standard deviation of the error of a stamp.
    """

    def __init__(self, physics: SegmentationPhysics, heights: Sequence[float], noise: Array, jitter: float) -> None:
        self.physics = physics
        self.rises = sorted((h + physics.radius for h in heights), reverse=True)
        self.noise = self.least = np.maximum(noise, FLOOR) ** 2
        self.jitter = jitter

    def set_noise(self, noises: Sequence[Array]) -> None:
        """The noise of a position is the largest of some (3,) m, and of that which it began with."""
        self.noise = np.max([self.least, *np.square(noises)], axis=0)

    def on_path(self, ball: Known, time: float, positions: Array) -> Array:
        """(n,) squared Mahalanobis distances of positions (n, 3) m from a ball that flew on or bounced.

        After a long silence they are scaled, so that `GATE` applies to them too.
        """
        dt = time - ball.time
        mean, covariance = self._flown(ball, dt)
        distance = self._distance(mean, covariance, ball, positions)
        bounced = self._bounced(ball, dt, mean, covariance) if dt > 0.0 else None
        if bounced is not None:
            distance = np.minimum(distance, self._distance(*bounced, ball, positions))
        return distance * (GATE / LONG_GATE) if abs(dt) > HIT_TIME else distance

    def if_hit(self, ball: Known, time: float, positions: Array) -> Array:
        """(n,) the same from a ball that may have been hit; infinite after too long a silence."""
        dt = time - ball.time
        if abs(dt) > HIT_TIME:
            return np.full(len(positions), np.inf)
        velocity = ball.mean[3:]
        mean = ball.mean[:3] + 0.5 * dt * velocity
        way = (HIT_SPEED + 0.5 * float(np.linalg.norm(velocity))) * abs(dt) + FLOOR
        return self._distance(mean, ball.covariance[:3, :3] + way**2 * np.eye(3), ball, positions)

    def _distance(self, mean: Array, covariance: Array, ball: Known, positions: Array) -> Array:
        spread = covariance + np.diag(self.noise)
        if self.jitter:
            way = self.jitter * ball.mean[3:]
            spread = spread + np.outer(way, way)
        away = positions - mean
        return np.asarray(np.einsum("ni,ni->n", away, np.linalg.solve(spread, away.T).T))

    def _flown(self, ball: Known, dt: float) -> tuple[Array, Array]:
        """Mean (3,) m and covariance (3, 3) m^2 of the place of a ball in flight, dt s later or earlier."""
        P, velocity = ball.covariance, ball.mean[3:]
        pull = -self.physics.drag * float(np.linalg.norm(velocity)) * velocity
        pull[2] -= self.physics.gravity
        cross = dt * P[:3, 3:]
        covariance = P[:3, :3] + cross + cross.T + dt**2 * P[3:, 3:] + (0.5 * SLACK * dt**2) ** 2 * np.eye(3)
        return ball.mean[:3] + dt * velocity + 0.5 * dt**2 * pull, covariance

    def _bounced(self, ball: Known, dt: float, flown: Array, covariance: Array) -> tuple[Array, Array] | None:
        """The same for a ball that met a surface on the way; None if none was within reach."""
        z, vz, g = float(ball.mean[2]), float(ball.mean[5]), self.physics.gravity
        sigma = math.sqrt(covariance[2, 2])
        lean = self.physics.rise(*flown[:2].tolist())
        for rise in (height + lean for height in self.rises):
            if z < rise - 3.0 * sigma - 2 * self.physics.radius or flown[2] > rise + 3.0 * sigma:
                continue
            fall = math.sqrt(max(vz * vz + 2 * g * (z - rise), 0.0))
            after = min(max(dt - (vz + fall) / g, 0.0), dt)  # s since the contact
            up = self.physics.restitution * fall * after - 0.5 * g * after**2
            mean = np.array([flown[0], flown[1], rise + max(up, 0.0)])
            slide, rebound = (SLIDE * after) ** 2, (0.15 * fall * after) ** 2
            return mean, covariance + np.diag([slide, slide, rebound + self.physics.radius**2 / 4])
        return None


def assign(costs: Array, limit: float) -> list[tuple[int, int]]:
    """The assignment of rows to columns with the smallest sum; pairs above a limit stay apart.

    Args: costs: (n, m) dimensionless.  limit: of one pair.
    """
    if costs.size == 0:
        return []
    allowed = np.where(costs <= limit, costs, FAR)
    if 1 in costs.shape:  # one ball or one position
        nearest = np.unravel_index(int(allowed.argmin()), costs.shape)
        pairs = [(int(nearest[0]), int(nearest[1]))]
    else:
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import min_weight_full_bipartite_matching

        # quicker to import than scipy.optimize; one more for each pair, since a sparse matrix has no pairs that cost 0
        rows, columns = min_weight_full_bipartite_matching(csr_array(allowed + 1.0))
        pairs = list(zip(rows.tolist(), columns.tolist(), strict=True))
    return [(i, j) for i, j in pairs if costs[i, j] <= limit]
