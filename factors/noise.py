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
        contact_tangential: m/s, what its two components along the surface have on top: friction, which no track tells.
        contact_spin: rad/s, the same of its spin.
        hit_velocity: m/s, of the velocity after a hit (racket, arm, net).
        hit_spin: rad/s, of the spin after a hit.
    """

    acceleration: float = 0.1
    spin: float = 1.0
    contact_velocity: float = 0.02
    contact_tangential: float = 0.0
    contact_spin: float = 5.0
    hit_velocity: float = 10.0
    hit_spin: float = 100.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and (value > 0.0 or (value == 0.0 and name == "contact_tangential"))):
                raise ValueError(
                    f"{name} must be positive and finite; got {value}. Use a small number for a nearly exact model."
                )

    def flight(self, dt: Array) -> Array:
        """(n, 9, 9) covariance gathered in free flight over dt (n,) s."""
        return _white_acceleration(dt, self.acceleration, self.spin)

    def contact(self, dt: Array, time: Array) -> Array:
        """(n, 9, 9) covariance at the end of intervals dt (n,) s of an impact at `time` (n,) s."""
        tangential = np.hypot(self.contact_velocity, self.contact_tangential)
        return self.kick(dt, time, (tangential, tangential, self.contact_velocity), self.contact_spin)

    def hit(self, dt: Array) -> Array:
        """(n, 9, 9) covariance at the end of intervals dt (n,) s of a hit at an unknown time in them."""
        ends = (np.zeros_like(dt), dt)
        return np.asarray(sum(0.5 * self.kick(dt, t, (self.hit_velocity,) * 3, self.hit_spin) for t in ends))

    @staticmethod
    def kick(dt: Array, time: Array, velocity: tuple[float, float, float], spin: float) -> Array:
        """(n, 9, 9) covariance at the end of intervals dt (n,) s of a jump in velocity and spin at `time` (n,) s.

        The velocity's jump (standard deviation per axis) has moved the ball by then.
        """
        reach = np.zeros((len(dt), STATE_DIM, 6))
        left = np.clip(dt - time, 0.0, dt)
        for i in range(3):
            reach[:, i, i] = left * velocity[i]
            reach[:, 3 + i, i] = velocity[i]
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
