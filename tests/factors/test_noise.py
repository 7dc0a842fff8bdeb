"""Process noise against the matrix exponential, its own composition, and jumps drawn at random."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from ballfg.dynamics.compiled.beliefs.carry import add_flight
from ballfg.factors.noise import ProcessNoise, whitening
from ballfg.state import POSITION, SPIN, VELOCITY

NOISE = ProcessNoise(acceleration=0.7, spin=3.0, contact_velocity=0.05, contact_tangential=0.2, contact_spin=7.0)


def transition(dt: float) -> np.ndarray:
    """(9, 9) of a ball that is not accelerated."""
    F = np.eye(9)
    F[POSITION, VELOCITY] = dt * np.eye(3)
    return F


def van_loan(dt: float) -> np.ndarray:
    """Covariance of dx = A x dt + noise over dt (C. Van Loan, Computing integrals ..., IEEE Trans. AC 23, 1978)."""
    A, density = np.zeros((9, 9)), np.zeros((9, 9))
    A[POSITION, VELOCITY] = np.eye(3)
    density[VELOCITY, VELOCITY] = NOISE.acceleration**2 * np.eye(3)
    density[SPIN, SPIN] = NOISE.spin**2 * np.eye(3)
    block = expm(dt * np.block([[-A, density], [np.zeros((9, 9)), A.T]]))
    return block[9:, 9:].T @ block[:9, 9:]


@pytest.mark.parametrize("dt", [1e-3, 0.01, 0.2, 3.0])
def test_flight_is_the_integral_of_white_noise(dt) -> None:
    np.testing.assert_allclose(NOISE.flight(np.array([dt]))[0], van_loan(dt), rtol=1e-10, atol=1e-18)


def test_machine_code_adds_the_same_noise() -> None:
    found = np.zeros((9, 9))
    add_flight(found, 0.013, np.array([NOISE.acceleration, NOISE.spin, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(found, NOISE.flight(np.array([0.013]))[0])


def test_a_dropped_frame_is_not_another_model() -> None:
    first, second = 0.013, 0.021
    Q1, Q2, both = NOISE.flight(np.array([first, second, first + second]))
    F = transition(second)
    np.testing.assert_allclose(F @ Q1 @ F.T + Q2, both, rtol=1e-12, atol=1e-20)


def test_contact_moves_the_ball_by_what_its_velocity_changed() -> None:
    """A kick of velocity and spin at `time`, carried on to the end; each axis with its own standard deviation."""
    dt, time = np.array([0.01, 0.01, 0.01]), np.array([0.004, -0.002, 0.015])  # inside, before, after the interval
    given = NOISE.contact(dt, time)
    kick = np.zeros((9, 9))
    tangential = 0.05**2 + 0.2**2
    kick[VELOCITY, VELOCITY] = np.diag([tangential, tangential, 0.05**2])
    kick[SPIN, SPIN] = 7.0**2 * np.eye(3)
    for covariance, left in zip(given, (0.006, 0.01, 0.0), strict=True):
        F = transition(left)
        np.testing.assert_allclose(covariance, F @ kick @ F.T, rtol=1e-12, atol=1e-18)


def test_hit_lets_the_ball_jump_at_either_end() -> None:
    """Half of a jump at the start and half of one at the end: position spread of a jump in the middle, and more."""
    dt = np.array([0.02])
    hit = NOISE.hit(dt)[0]
    np.testing.assert_allclose(np.diag(hit)[VELOCITY], NOISE.hit_velocity**2)
    np.testing.assert_allclose(np.diag(hit)[SPIN], NOISE.hit_spin**2)
    np.testing.assert_allclose(np.diag(hit)[POSITION], 0.5 * (NOISE.hit_velocity * 0.02) ** 2)
    middle = NOISE.kick(dt, dt / 2, (NOISE.hit_velocity,) * 3, NOISE.hit_spin)[0]
    assert (np.linalg.eigvalsh(hit - middle) > -1e-9).all()


def test_whitening_makes_the_identity() -> None:
    dt = np.array([1e-4, 0.01, 0.3])
    covariance = NOISE.flight(dt) + NOISE.contact(dt, dt / 3)
    covariance[1] += NOISE.hit(dt[1:2])[0]
    root = whitening(covariance)
    np.testing.assert_allclose(root @ covariance @ root.swapaxes(1, 2), np.tile(np.eye(9), (3, 1, 1)), atol=1e-9)


def test_whitening_survives_very_different_scales() -> None:
    """1e-7 m beside 1e3 rad/s: the correlations are factorised, not the covariance."""
    covariance = np.diag(np.array([1e-14, 1e-2, 1e6]))[None]
    covariance[0, 0, 1] = covariance[0, 1, 0] = 0.99 * np.sqrt(1e-14 * 1e-2)
    root = whitening(covariance)
    np.testing.assert_allclose(root[0] @ covariance[0] @ root[0].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    "field", ["acceleration", "spin", "contact_velocity", "contact_spin", "hit_velocity", "hit_spin"]
)
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_noise_must_be_positive(field, value) -> None:
    with pytest.raises(ValueError, match=f"{field} must be positive and finite"):
        ProcessNoise(**{field: value})
    assert ProcessNoise(contact_tangential=0.0).contact_tangential == 0.0
