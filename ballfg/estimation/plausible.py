"""Replaces impossible estimates (not numbers, out of bounds) by the measured positions with wide covariances."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import NOTHING, ONE, TWO
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import Settings
from ballfg.factors.linear.definite import compatible, definite, variances_positive
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY
from ballfg.tracks import Track
from ballfg.tracks.checks import MAX_COORDINATE
from ballfg.tracks.track import FASTEST_BALL, FASTEST_SPIN

LEAST_POSITION_SIGMA = 0.05  # m. Least standard deviation of a position in a track that no graph explains


def plausible(estimate: Estimate, track: Track, sigma: Array, settings: Settings) -> Estimate:
    """The estimate with positive definite covariances, its impossible states replaced by the measurements.

    Args:
        estimate: of the track.  track: gives the positions.  sigma: (n, 3) m, of the positions.
        settings: give the priors.
    Returns: the same estimate if nothing is wrong with it, else one whose status says so.
    """
    wrong = ~(possible(estimate.states) & variances_positive(estimate.covariances))
    finite = np.isfinite(estimate.coefficients).all() and np.isfinite(estimate.cross_covariances).all()
    lost = not (finite and variances_positive(estimate.coefficient_covariance).all())
    covariances = estimate.covariances
    status = Status.FAILED if estimate.status is Status.FAILED else Status.IMPLAUSIBLE
    if wrong.any():
        states, priors = measured_only(track.positions, np.maximum(sigma, LEAST_POSITION_SIGMA), settings)
        covariances = np.where(wrong[:, None, None], priors, covariances)
        estimate = replace(
            estimate,
            states=np.where(wrong[:, None], states, estimate.states),
            other_sides=np.where(wrong[: len(estimate.other_sides), None, None], 0.0, estimate.other_sides),
            status=status,
            struck={},
        )
    if lost:
        coefficients = np.array(list(settings.coefficients.values()))
        estimate = replace(
            estimate,
            coefficients=np.where(np.isfinite(estimate.coefficients), estimate.coefficients, 0.0),
            coefficient_covariance=np.diag(coefficients**2),
            status=status,
            struck={},
        )
    covariances, shared = definite(covariances), estimate.coefficient_covariance
    shared = definite(shared) if shared.size else shared
    cross = np.where((wrong | lost)[:, None, None], 0.0, estimate.cross_covariances)
    return replace(
        estimate,
        covariances=covariances,
        coefficient_covariance=shared,
        cross_covariances=compatible(cross, covariances, shared),
    )


def possible(states: Array) -> NDArray[np.bool_]:
    """(...) bool: True for states (..., 9) that are finite and possible for a ball.

    A track lies within `MAX_COORDINATE` m; no ball is faster than `FASTEST_BALL` m/s or spins faster than
    `FASTEST_SPIN` rad/s.
    """
    own, fits = np.ascontiguousarray(states.reshape(-1, STATE_DIM), dtype=np.float64), np.empty(states.shape[:-1])
    _fits(own, fits.reshape(-1))
    return np.asarray(fits > 0.0)


@machine_code(NOTHING(TWO, ONE), makes_arrays=False)
def _fits(states: Array, fits: Array) -> None:
    """Writes 1 for each state (n, 9) that is possible, else 0; comparisons with what is not a number are false."""
    for k in range(len(states)):
        near, speed, spin = True, 0.0, 0.0
        for i in range(3):
            near = near and abs(states[k, i]) <= 2.0 * MAX_COORDINATE
            speed += states[k, 3 + i] ** 2
            spin += states[k, 6 + i] ** 2
        fits[k] = 1.0 if near and speed <= FASTEST_BALL**2 and spin <= FASTEST_SPIN**2 else 0.0


def measured_only(positions: Array, sigma: Array, settings: Settings) -> tuple[Array, Array]:
    """States (n, 9) from positions (n, 3) m with sigmas (n, 3) m, without velocity, and their (n, 9, 9)."""
    states, spread = np.zeros((len(positions), STATE_DIM)), np.empty((len(positions), STATE_DIM))
    states[:, POSITION] = positions
    spread[:, POSITION] = sigma
    spread[:, VELOCITY], spread[:, SPIN] = settings.velocity_prior, settings.spin_prior
    return states, spread[..., None] ** 2 * np.eye(STATE_DIM)
