"""The sliding-window mean against closed forms, its covariance against simulation, and fits that start smoothers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import nominal_model
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.effects.flight import Gravity
from ballfg.dynamics.motion.rollout import rollout
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.filters.sliding_window import SlidingWindow, may_touch
from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.state import POSITION, SPIN, VELOCITY
from ballfg.tracks import Track
from tests.estimation.nees import nees

DT = 0.01
TIMES = np.arange(40) * DT
FAR = Surfaces(table_height=-100.0)
TABLE = Surfaces.table_tennis(0.0)
GRAVITY = np.array([0.0, 0.0, -9.81])
SPIN_LABEL = {"spin_x": 1.0, "spin_y": 60.0, "spin_z": -3.0}


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def parabola(acceleration, times=TIMES) -> tuple[np.ndarray, np.ndarray]:
    t = times[:, None]
    velocity = np.array([5.0, 0.5, 2.0]) + np.asarray(acceleration) * t
    return np.array([0.0, 0.0, 0.3]) + np.array([5.0, 0.5, 2.0]) * t + np.asarray(acceleration) * t**2 / 2, velocity


def estimate(track: Track, model=None, surfaces=FAR, settings=None):
    return SlidingWindow(model or AnalyticModel([Gravity()]), surfaces, settings or Settings()).estimate(track)


# --- the estimator -----------------------------------------------------------------------------------------------


def test_straight_motion_is_exact():
    positions, velocities = parabola(np.zeros(3))
    result = estimate(Track(TIMES, positions, labels=SPIN_LABEL, name="line"))
    np.testing.assert_allclose(result.states[1:, VELOCITY], velocities[1:], rtol=1e-10)
    np.testing.assert_array_equal(result.states[:, POSITION], positions)
    np.testing.assert_array_equal(result.states[:, SPIN], np.tile([1.0, 60.0, -3.0], (40, 1)))
    assert result.status is Status.OK
    assert np.isnan(result.whitened).all()


def test_constant_acceleration_lags_by_half_the_window():
    positions, velocities = parabola(GRAVITY)
    result = estimate(Track(TIMES, positions, name="parabola"))
    lag = velocities - result.states[:, VELOCITY]
    np.testing.assert_allclose(lag[4:], np.tile(GRAVITY * 2 * DT, (36, 1)), atol=1e-10)
    np.testing.assert_allclose(lag[1:4], GRAVITY * DT * np.array([[0.5], [1.0], [1.5]]), atol=1e-10)


def test_first_sample_has_the_prior_velocity():
    result = estimate(Track(TIMES, parabola(GRAVITY)[0], name="parabola"))
    np.testing.assert_array_equal(result.states[0, VELOCITY], np.zeros(3))
    np.testing.assert_array_equal(result.covariances[0, VELOCITY, VELOCITY], 400.0 * np.eye(3))
    assert not result.covariances[0, POSITION, VELOCITY].any()


def test_covariance_is_the_mean_squared_error(rng):
    settings = Settings(position_noise=(0.001, 0.002, 0.003), spin_label_noise=1e-3)
    positions, velocities = parabola(GRAVITY)
    truth = np.concatenate((positions[10], velocities[10]))
    errors = []
    for _ in range(2500):
        noise = settings.position_noise * rng.standard_normal((11, 3))
        result = estimate(Track(TIMES[:11], positions[:11] + noise, name="noisy"), settings=settings)
        errors.append(result.states[-1, :6] - truth)
    squared = np.einsum("ni,nj->ij", errors, errors) / len(errors)
    stated = estimate(Track(TIMES, positions, name="parabola"), settings=settings).covariances[10, :6, :6]
    scale = np.sqrt(np.diag(stated))
    np.testing.assert_allclose(squared / np.outer(scale, scale), stated / np.outer(scale, scale), atol=0.08)


def test_covariance_covers_unknown_spin_and_bounce(rng):
    """Over random shots with a bounce the mean NEES of the velocity stays near 3, in and out of the bounce."""
    model, settings = nominal_model(), Settings(position_noise=(0.002,) * 3, spin_prior=40.0)
    spread = np.array([0, 0, 0.1, 1, 0.5, 0.7, 40, 40, 40]) * rng.standard_normal((60, 9))
    start = np.array([0, 0, 0.3, 5, 0.5, 0, 0, 0, 0]) + spread
    start[:, 2] = start[:, 2].clip(0.1)
    with torch.no_grad():
        truth = rollout(model, torch.from_numpy(start), torch.from_numpy(TIMES), TABLE).numpy()
    far = []
    for states in truth:
        track = Track(TIMES, states[:, POSITION] + 0.002 * rng.standard_normal((40, 3)), name="shot")
        result = estimate(track, model, TABLE, settings)
        far.append(nees(result, states, VELOCITY))
    assert 2.0 < np.mean(far) < 4.0
    bounced = np.array([np.abs(np.diff(states[:, 5], prepend=states[0, 5])).max() > 2.0 for states in truth])
    assert bounced.sum() > 20
    assert np.mean(np.max(far, axis=1) < 30.0) > 0.9


def test_spin_is_less_known_after_a_bounce():
    with torch.no_grad():
        start = torch.tensor([[0, 0, 0.2, 5, 0.5, 0, 0, 0, 0]], dtype=torch.float64)
        states = rollout(nominal_model(), start, torch.from_numpy(TIMES), TABLE)[0].numpy()
    result = estimate(Track(TIMES, states[:, POSITION], labels=SPIN_LABEL, name="shot"), nominal_model(), TABLE)
    np.testing.assert_allclose(result.sigmas[:10, 6], 20.0, rtol=0.01)
    assert result.sigmas[-1, 6] > 60.0


def test_own_sigmas_take_precedence():
    positions, _ = parabola(GRAVITY)
    result = estimate(Track(TIMES, positions, sigmas=np.full((40, 3), 0.01), name="own"))
    np.testing.assert_allclose(result.sigmas[:, :3], 0.01)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_short_tracks(count):
    result = estimate(Track(TIMES[:count], parabola(GRAVITY)[0][:count], name="short"))
    assert result.status is (Status.NO_VELOCITY if count == 1 else Status.OK)
    assert result.states.shape == (count, 9)
    assert (np.linalg.eigvalsh(result.covariances)[:, 0] > 0).all()


def test_bounce_is_suspected_only_near_a_surface():
    positions, _ = parabola(GRAVITY)
    assert not may_touch(TIMES, positions, FAR, 0.02).any()
    assert may_touch(TIMES, positions - [0, 0, 0.28], TABLE, 0.02)[1]


# --- fits for starting points ------------------------------------------------------------------------------------


def test_parabolas_are_fitted_exactly_at_uneven_stamps(rng):
    times = np.cumsum(rng.uniform(0.002, 0.03, 30))
    positions, velocities = parabola(GRAVITY, times)
    np.testing.assert_allclose(window_velocities(times, positions), velocities, rtol=1e-9, atol=1e-9)


def test_no_window_reaches_across_a_break():
    positions, velocities = parabola(GRAVITY)
    positions, velocities = positions.copy(), velocities.copy()
    for first, jump in ((8, [0.0, 0.0, 4.0]), (9, [1.0, 0.0, 0.0]), (30, [-3.0, 2.0, 1.0]), (32, [0.0, 0.0, 5.0])):
        positions[first:] += np.array(jump) * (TIMES[first:, None] - TIMES[first] + DT / 3)
        velocities[first:] += jump
    breaks = [7, 8, 29, 31]
    fitted = window_velocities(TIMES, positions, breaks)
    alone = 8  # a single sample between two breaks
    exact = np.delete(np.arange(40), alone)
    np.testing.assert_allclose(fitted[exact], velocities[exact], rtol=1e-8, atol=1e-8)
    slopes = np.diff(positions, axis=0)[[7, 8]] / DT
    np.testing.assert_allclose(fitted[alone], slopes.mean(axis=0), rtol=1e-8)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
def test_short_tracks_are_finite(count):
    positions, velocities = parabola(GRAVITY)
    for breaks in ([], list(range(count - 1))):
        fitted = window_velocities(TIMES[:count], positions[:count], breaks)
        assert np.isfinite(fitted).all()
        if not breaks and count > 1:
            np.testing.assert_allclose(fitted, velocities[:count], atol=1e-9)
    assert not window_velocities(TIMES[:1], positions[:1]).any()


def test_noise_is_averaged_as_least_squares_should(rng):
    noise = 0.002 * rng.standard_normal((4000, 3))
    fitted = window_velocities(np.arange(4000) * DT, noise)
    expected = 0.002 / (DT * np.sqrt(10.0))  # sum of squares of -2..2
    assert abs(fitted[2:-2, 0].std() / expected - 1.0) < 0.05
