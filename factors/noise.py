"""Process noise: a continuous-time density, discretised for each interval, with more where a ball is hit or bounces.

Over an interval dt white acceleration noise of density q (m/s^2 per sqrt(Hz)) gives position and velocity, per axis,
the covariance q^2 [[dt^3/3, dt^2/2], [dt^2/2, dt]]; spin is a random walk. So a dropped frame is the same model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ProcessNoise:
    """How far a real ball strays from its model.

    Attributes:
        acceleration: m/s^2/sqrt(Hz), density of the acceleration that the model lacks.
        spin: rad/s/sqrt(s), density of the spin's random walk. Must be positive: the square-root information of a
            chain of exactly equal spins is singular to working precision.
        contact_velocity: m/s, standard deviation per axis of an impact's outgoing velocity.
        contact_spin: rad/s, the same of its spin.
        hit_velocity: m/s, of the velocity after a hit (racket, arm, net).
        hit_spin: rad/s, of the spin after a hit.
    """

    acceleration: float = 0.09
    spin: float = 1.0
    contact_velocity: float = 0.02
    contact_spin: float = 5.0
    hit_velocity: float = 10.0
    hit_spin: float = 100.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(
                    f"{name} must be positive and finite; got {value}. Use a small number for a nearly exact model."
                )

    def flight(self, dt: Array) -> Array:
        """(n, 9, 9) covariance gathered in free flight over dt (n,) s."""
        return _white_acceleration(dt, self.acceleration, self.spin)

    def kick(self, dt: Array, time: Array, velocity: float, spin: float) -> Array:
        """(n, 9, 9) covariance at the end of intervals dt (n,) s of a jump in velocity and spin at `time` (n,) s.

        The velocity's jump has moved the ball by then; for a jump of unknown time pass half the interval.
        """
        reach = np.zeros((len(dt), STATE_DIM, 6))
        left = np.clip(dt - time, 0.0, dt)
        for i in range(3):
            reach[:, i, i] = left * velocity
            reach[:, 3 + i, i] = velocity
            reach[:, 6 + i, 3 + i] = spin
        return reach @ reach.swapaxes(-1, -2)


def _white_acceleration(dt: Array, acceleration: float, spin: float) -> Array:
    covariance = np.zeros((len(dt), STATE_DIM, STATE_DIM))
    eye, t = np.eye(3), dt[:, None, None]
    covariance[:, POSITION, POSITION] = acceleration**2 * t**3 / 3 * eye
    covariance[:, POSITION, VELOCITY] = acceleration**2 * t**2 / 2 * eye
    covariance[:, VELOCITY, POSITION] = covariance[:, POSITION, VELOCITY]
    covariance[:, VELOCITY, VELOCITY] = acceleration**2 * t * eye
    covariance[:, SPIN, SPIN] = spin**2 * t * eye
    return covariance


def whitening(covariance: Array) -> Array:
    """(n, m, m) matrices W with W C W^T = 1, of covariances C (n, m, m)."""
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    return np.linalg.inv(np.linalg.cholesky(correlation)) / scale[..., None, :]
