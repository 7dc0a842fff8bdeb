"""What every estimator returns: states with covariances, and how far to trust them."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ballfg.estimation.segmentation import Contact
from ballfg.factors.batch import Rows
from ballfg.factors.covariance import Covariances
from ballfg.factors.linear import weighted
from ballfg.state import POSITION

Array = NDArray[np.float64]

LEAST_INFORMATION = 1e-6
"""Share of the posterior's information that the other samples are given at least."""


class Status(enum.Enum):
    """How an estimation ended; the value is a sentence that says what to do."""

    OK = "converged"
    NOT_CONVERGED = (
        "no estimate explains the samples; the states are the best that was reached. Check the table height and the "
        "noise settings, or look at the track for events that the model cannot explain"
    )
    NO_VELOCITY = (
        "there are too few samples to tell a velocity: the states are the measured positions and the priors. "
        "Observe at least three samples of each flight"
    )
    FAILED = (
        "the objective is not finite at the start; the states are the measured positions and the priors. Check the "
        "table height: the ball seems to be far below a surface that it bounces on"
    )


@dataclass(frozen=True)
class Estimate:
    """The states of one track.

    Attributes:
        name: of the track.
        times: (n,) s, the track's stamps.
        states: (n, 9) position m, velocity m/s, spin rad/s.
        covariances: (n, 9, 9).
        status: how the estimation ended.
        whitened: (n, 3) whitened innovations. For a filter: measured minus predicted position; for a smoother:
            measured position minus its prediction from all other samples. Each divided by its standard deviation:
            standard normal where model and noise are right. NaN where a method has none. Of a `SightedTrack`, (m, 2):
            one row a sighting, pixels in place of positions.
        coefficient_names: of the p model parameters that were estimated with the track.
        coefficients: (p,).  coefficient_covariance: (p, p).
        cross_covariances: (n, 9, p) between each state and the coefficients.
        contacts: with a surface, in order.
        hits: intervals (between samples i and i+1) in which something hit the ball.
        quality: (n,) `segmentation.Quality` of each sample.
        error: objective at the minimum; NaN for methods without one.
        iterations: linear solutions of a minimisation, 0 for methods without one.
        cameras: names of the c cameras of a `SightedTrack`, where an estimate was made from its sightings.
        time_offsets: (c,) s, of the cameras: their own, or as estimated. `times` are true by these.
        time_offset_covariance: (c, c) s^2, zero for those that were not estimated.
    """

    name: str
    times: Array
    states: Array
    covariances: Array
    status: Status
    whitened: Array
    coefficient_names: tuple[str, ...] = ()
    coefficients: Array = field(default_factory=lambda: np.zeros(0))
    coefficient_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    cross_covariances: Array = field(default_factory=lambda: np.zeros((0, 9, 0)))
    contacts: tuple[Contact, ...] = ()
    hits: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    quality: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, dtype=np.int8))
    error: float = np.nan
    iterations: int = 0
    cameras: tuple[str, ...] = ()
    time_offsets: Array = field(default_factory=lambda: np.zeros(0))
    time_offset_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def sigmas(self) -> Array:
        """(n, 9) standard deviations of the states."""
        return np.sqrt(np.diagonal(self.covariances, axis1=-2, axis2=-1))

    @property
    def nis(self) -> Array:
        """(n,) squared length of the whitened innovations: chi-square with as many degrees of freedom as they have."""
        return np.asarray((self.whitened**2).sum(axis=-1))


def whiten_innovation(innovation: Array, covariance: Array) -> Array:
    """(n, 3) innovations divided by the root of their covariances (n, 3, 3)."""
    root = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.solve(root, innovation[..., None])[..., 0])


def leave_one_out(states: Array, covariances: Array, measured: Array, sigma: Array, samples: Rows) -> Array:
    """(n, 3) whitened innovations of a smoother: each sample against its prediction from all others.

    With the sample's share M taken out of the posterior information, the others know the position to C = (P^-1 - M)^-1;
    without the sample's pull g = M (x - z) (for a robust loss: its gradient) they place it at x + C g. The measurement
    z lies z - x - C g from there, with covariance R + C.

    Args:
        states: (n, 9).  covariances: (n, 9, 9).
        measured: (n, 3) m.  sigma: (n, 3) m.
        samples: the position factors, linearised at the states.
    """
    residual, (jacobian,) = weighted(samples)
    jacobian = jacobian[..., POSITION]
    pull = (jacobian.swapaxes(-1, -2) @ residual[..., None])[..., 0]
    information = np.linalg.inv(covariances[:, POSITION, POSITION])
    axes = np.arange(3)
    others = information - jacobian.swapaxes(-1, -2) @ jacobian
    # a sample that alone decides its position leaves nothing: bound C, the whitened distance goes to zero
    others[:, axes, axes] += LEAST_INFORMATION * information[:, axes, axes]
    covariance = np.linalg.inv(others)
    distance = measured - states[:, POSITION] - (covariance @ pull[..., None])[..., 0]
    covariance[:, axes, axes] += sigma**2
    return whiten_innovation(distance, np.asarray(covariance, dtype=np.float64))


def leave_sighting_out(sightings: Rows, covariances: Covariances) -> Array:
    """(m, 2) whitened innovations of a smoother: each sighting against its prediction from all others.

    As `leave_one_out`, in pixels that are whitened by their noise: with H the Jacobian of a sighting and S = H P H^T
    its share of what is known of it, the others know what it will show to C = S (1 - S)^-1, and see it at a distance
    -(r + C r) from there; for a robust loss, H and r in S and in the pull are the weighted ones. The covariance of that
    is 1 + C.

    Args:
        sightings: the camera factors, linearised at the minimum.
        covariances: of the states there and of the coefficients.
    """
    state = sightings.variables[:, 0]
    plain, (residual, jacobians) = np.concatenate(sightings.jacobians, axis=-1), weighted(sightings)
    pulled = np.concatenate(jacobians, axis=-1)
    joint = covariances.states[state]
    if len(jacobians) > 1:
        cross = covariances.cross[state]
        both = np.broadcast_to(covariances.coefficients, (len(state), *covariances.coefficients.shape))
        joint = np.block([[joint, cross], [cross.swapaxes(-1, -2), both]])
    gain = joint @ pulled.swapaxes(-1, -2)
    # a sighting that alone decides what it shows leaves nothing: bound C, the whitened distance goes to zero
    left = np.linalg.inv((1.0 + LEAST_INFORMATION) * np.eye(2) - pulled @ gain)
    others = joint + gain @ left @ gain.swapaxes(-1, -2)
    pull = pulled.swapaxes(-1, -2) @ residual[..., None]
    distance = -sightings.residual - (plain @ others @ pull)[..., 0]
    return whiten_innovation(distance, np.eye(2) + plain @ others @ plain.swapaxes(-1, -2))
