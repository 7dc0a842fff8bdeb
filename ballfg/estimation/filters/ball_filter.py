"""Extends filterpy's extended Kalman filter by the ball's own prediction."""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter as FilterpyEKF
from scipy.special import chdtri

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.arrays import Advance, advance_jacobian
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.innovation import FilterInnovation
from ballfg.factors.batch import FactorBatch
from ballfg.factors.dynamics import model_width
from ballfg.factors.linear.definite import whitened
from ballfg.state import STANDARD_GRAVITY, STATE_DIM, VELOCITY, Z

GATE_CHANCE = 1e-6
"""Share of good measurements that are rejected: positions whose squared whitened innovation exceeds 30.7."""
WIDE_VELOCITY = 1.0
"""m/s. While the velocity is less certain, a step is linearised at the velocity that its sample suggests."""


class BallFilter(FilterpyEKF):
    """filterpy's filter with the ball's own prediction: x, P, F, Q, R are its attributes, the update is its own.

    The first `width` numbers of x move with the ball: its state and the model's coefficients. The tracker's bias, if
    any, follows them.

    Its update uses the Joseph form (I - K H) P (I - K H)^T + K R K^T, positive definite under rounding.
    """

    def __init__(self, model: BallModel, surfaces: Surfaces, mean: Array, covariance: Array, H: Array) -> None:
        super().__init__(dim_x=len(mean), dim_z=3)
        self.model = model
        self.surfaces = surfaces
        self.x = mean
        self.P = covariance
        self.H = H
        self.width = STATE_DIM + model_width(model)
        self.predicted = mean

    def move(self, point: Array, dt: float, decay: float) -> Advance:
        """Sets F at the linearisation point, and the mean that `predict_x` will put into x."""
        width = self.width
        motion = advance_jacobian(self.model, point[:width], dt, self.surfaces)
        self.F = np.diag(np.full(len(point), decay))
        self.F[:width, :width] = motion.jacobian
        self.predicted = decay * self.x
        self.predicted[:width] = motion.after + self.F[:width, :width] @ (self.x - point)[:width]
        return motion

    def time_to_contact(self, within: float) -> float:
        """The time until the next contact of the mean, s; infinite if there is none within so many s."""
        motion = advance_jacobian(self.model, self.x[: self.width], within, self.surfaces)
        return min((time for time, _ in motion.contacts), default=np.inf)

    @property
    def velocity_is_wide(self) -> bool:
        """True if the velocity is almost unknown."""
        return bool(np.trace(self.P[VELOCITY, VELOCITY]) >= WIDE_VELOCITY**2)

    def predict_x(self, u: float = 0) -> None:
        """The mean follows the nonlinear motion, not F x."""
        self.x = self.predicted

    def linearisation_point(self, measured: Array, dt: float, R: Array) -> Array:
        """(d,) the mean; while the velocity is wide, the mean given the interval's sample in drag-free flight.

        It only sets the linearisation point: the sample itself still updates the state once.
        """
        if not self.velocity_is_wide:
            return self.x
        P, H = self.P, self.H.copy()
        H[:, VELOCITY] = dt * np.eye(3)
        miss = measured - H @ self.x
        miss[Z] += 0.5 * STANDARD_GRAVITY * dt**2
        point = self.x.copy()
        point[:6] += (P @ H.T @ np.linalg.solve(H @ P @ H.T + R, miss))[:6]
        return point

    def innovation(self, measured: Array) -> Array:
        """(3,) whitened: measured minus predicted position over the root of its covariance H P H^T + R."""
        return whitened(measured - self.H @ self.x, self.H @ self.P @ self.H.T + self.R)

    @staticmethod
    def passes(innovation: Array) -> bool:
        """True if a whitened innovation (dim,) is within the gate."""
        return bool(innovation @ innovation <= chdtri(len(innovation), GATE_CHANCE))

    def correct(self, measured: Array) -> None:
        """The update of filterpy with a measured position."""
        self.update(measured, lambda _: self.H, lambda x: self.H @ x)

    def correct_by(self, factor: FactorBatch, gated: bool) -> Array:
        """(dim,) whitened innovation of a factor, by which the filter is updated if it passes the gate, if any.

        NaN if the factor says nothing about the state, as a speed about a ball at rest.
        """
        found = FilterInnovation.of(factor, self.x, self.P, biases=len(self.x) - self.width)
        if not found.H.any():
            return np.full(factor.dim, np.nan)
        if not gated or self.passes(found.whitened):
            self.update(np.zeros(factor.dim), lambda _: found.H, lambda _: found.residual, R=found.R)
        return found.whitened
