"""Process noise is a continuous-time density, discretised for each interval, with more at hits and bounces.

Over an interval the acceleration adds what `white_acceleration` says; spin is a random walk. So a dropped frame is the
same model.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.checks import as_float
from ballfg.deferred import torch
from ballfg.dynamics.compiled.flight import white_acceleration
from ballfg.state import STATE_DIM

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class ProcessNoise:
    """Noise of a real ball's motion about its model.

    Attributes:
        acceleration: m/s^2/sqrt(Hz), density of the unmodelled acceleration.
        spin: rad/s/sqrt(s), density of the spin's random walk. Must be positive: the square-root information of a
            chain of exactly equal spins is singular to working precision.
        contact_velocity: m/s, standard deviation per axis of an impact's outgoing velocity.
        contact_tangential: m/s, in addition for its two components along the surface: friction varies, and no track
            determines it.
        contact_spin: rad/s, the same for its spin.
        hit_velocity: m/s, of the velocity after a hit (racket, arm, net).
        hit_spin: rad/s, of the spin after a hit.

    Raises: ValueError: a number that is not positive and finite; `contact_tangential` may be zero.
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
            number = as_float(name, value)
            if not (np.isfinite(number) and (number > 0.0 or (number == 0.0 and name == "contact_tangential"))):
                raise ValueError(
                    f"{name} must be positive and finite; got {value}. Use a small number for a nearly exact model."
                )

    def flight(self, dt: Array) -> Array:
        """(n, 9, 9) covariance from free flight over dt (n,) s."""
        return along_all_axes(self.flight_along_one(dt))

    def flight_along_one(self, dt: Array) -> Array:
        """(n, 3, 3) of position (m), velocity (m/s) and spin (rad/s) along one axis, from free flight over dt (n,) s.

        All axes are alike and independent.
        """
        return _white_acceleration(dt, self.acceleration, self.spin)

    def contact(self, dt: Array, time: Array) -> Array:
        """(n, 9, 9) covariance at the end of intervals dt (n,) s of an impact at `time` (n,) s."""
        tangential = np.hypot(self.contact_velocity, self.contact_tangential)
        return self.kick(dt, time, (tangential, tangential, self.contact_velocity), self.contact_spin)

    def kicks(self, dt: Array, kicks: Kicks) -> Array:
        """(m, 9, 9) covariance at the end of intervals dt (m,) s of the contacts and hits in them."""
        covariance = np.zeros((len(dt), STATE_DIM, STATE_DIM))
        for time in kicks.times.T:
            covariance += self.contact(dt, time)
        covariance[kicks.hit] += self.hit(dt[kicks.hit])
        return covariance

    def hit(self, dt: Array) -> Array:
        """(n, 9, 9) covariance at the end of intervals dt (n,) s of a hit at an unknown time in them."""
        ends = (np.zeros_like(dt), dt)
        return np.asarray(sum(0.5 * self.kick(dt, t, (self.hit_velocity,) * 3, self.hit_spin) for t in ends))

    @staticmethod
    def kick(dt: Array, time: Array, velocity: tuple[float, float, float], spin: float) -> Array:
        """(n, 9, 9) covariance at the end of intervals dt (n,) s of a jump in velocity and spin at `time` (n,) s.

        The velocity's jump (standard deviation per axis) has displaced the ball by then.
        """
        reach = np.zeros((len(dt), STATE_DIM, 6))
        left = np.clip(dt - time, 0.0, dt)
        for i in range(3):
            reach[:, i, i] = left * velocity[i]
            reach[:, 3 + i, i] = velocity[i]
            reach[:, 6 + i, 3 + i] = spin
        return reach @ reach.swapaxes(-1, -2)


PROCESS_NOISE = tuple(field.name for field in fields(ProcessNoise))
"""Names of its numbers, in the order of `variances` and `Kicks.basis`."""


@dataclass(frozen=True)
class Kicks:
    """The contacts and hits of a ball within m intervals, which add to the process noise.

    Attributes:
        times: (m, c) s since the interval's start, of c contacts in each.
        hit: (m,) bool, True if something hits the ball at an unknown moment.
    """

    times: Array
    hit: NDArray[np.bool_]

    @staticmethod
    def none(count: int) -> Kicks:
        """Free flight in all intervals."""
        return Kicks(np.zeros((count, 0)), np.zeros(count, dtype=bool))

    def __getitem__(self, rows: NDArray[np.int64] | slice) -> Kicks:
        return Kicks(self.times[rows], self.hit[rows])

    def basis(self, dt: Array) -> Array:
        """(m, 7, 9, 9) covariance over dt (m,) s for a unit of each number of `PROCESS_NOISE`.

        The covariance is linear in the squares of those numbers, so that gradients by them are simple.
        """
        basis = np.zeros((len(dt), len(PROCESS_NOISE), STATE_DIM, STATE_DIM))
        basis[:, 0] = along_all_axes(_white_acceleration(dt, 1.0, 0.0))
        basis[:, 1] = along_all_axes(_white_acceleration(dt, 0.0, 1.0))
        for time in self.times.T:
            basis[:, 2] += ProcessNoise.kick(dt, time, (1.0, 1.0, 1.0), 0.0)
            basis[:, 3] += ProcessNoise.kick(dt, time, (1.0, 1.0, 0.0), 0.0)
            basis[:, 4] += ProcessNoise.kick(dt, time, (0.0, 0.0, 0.0), 1.0)
        if self.hit.any():
            for time in (np.zeros_like(dt), dt):
                half = 0.5 * self.hit[:, None, None]
                basis[:, 5] += half * ProcessNoise.kick(dt, time, (1.0, 1.0, 1.0), 0.0)
                basis[:, 6] += half * ProcessNoise.kick(dt, time, (0.0, 0.0, 0.0), 1.0)
        return basis


SHORTEST = 1e-7
"""s. A shorter interval gets the position noise of this one: 2e-12 m for 0.1 m/s^2/sqrt(Hz). Positions of some metres
are rounded to 1e-15 m; for two samples 1 ns apart rounding alone would contradict the motion."""


def _white_acceleration(dt: Array, acceleration: float, spin: float) -> Array:
    """(n, 3, 3) of position, velocity and spin along one axis."""
    covariance = np.zeros((len(dt), 3, 3))
    _, between, covariance[:, 1, 1] = white_acceleration(dt, acceleration**2)
    covariance[:, 0, 1] = covariance[:, 1, 0] = between
    covariance[:, 0, 0] = white_acceleration(np.maximum(dt, SHORTEST), acceleration**2)[0]
    covariance[:, 2, 2] = spin**2 * dt
    return covariance


def along_all_axes(one: Array) -> Array:
    """(n, 9, 9) matrices of states from (n, 3, 3) of position, velocity and spin along any axis."""
    found = np.zeros((len(one), 3, 3, 3, 3))
    for axis in range(3):
        found[:, :, axis, :, axis] = one
    return found.reshape(len(one), STATE_DIM, STATE_DIM)


def whitening(covariance: Array) -> Array:
    """(n, m, m) matrices W with W C W^T = 1, of covariances C (n, m, m)."""
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    return np.linalg.inv(np.linalg.cholesky(correlation)) / scale[..., None, :]


def whitening_tensor(covariance: Tensor) -> Tensor:
    """`whitening` in torch, differentiable."""
    scale = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    root = torch.linalg.cholesky(covariance / (scale.unsqueeze(-1) * scale.unsqueeze(-2)))
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype).expand_as(covariance)
    return torch.linalg.solve_triangular(root, eye, upper=False) / scale.unsqueeze(-2)
