"""A tracker with memory and jittering stamps: estimators against dense solutions, and by consistency statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.filters.sliding_window import SlidingWindow
from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.estimation.online.online import Online
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track
from tests.estimation.tracker_noise import FALLING, NOWHERE, Dense, G, falling_track, gravity_model

JITTER = replace(FALLING, stamp_jitter=0.001)


def white(track: Track, settings: Settings) -> np.ndarray:
    """(n, 3, 3) m^2, of the errors that are new in each sample, along the velocities of line fits."""
    way = settings.stamp_jitter * window_velocities(track.times, track.positions)
    return np.diag(np.square(settings.position_noise)) + way[:, :, None] * way[:, None, :]


def check_same(
    states: np.ndarray, covariances: np.ndarray, means: np.ndarray, dense: np.ndarray, tolerance: float = 1e-6
) -> None:
    """Relative to the standard deviations."""
    sigma = np.sqrt(np.diagonal(dense, axis1=-2, axis2=-1))[..., :9]
    unit = sigma[..., :, None] * sigma[..., None, :]
    assert np.abs((states - means[..., :9]) / sigma).max() < tolerance
    assert np.abs((covariances - dense[..., :9, :9]) / unit).max() < tolerance


# --- a linear problem: gravity alone, no surface -----------------------------------------------------------------


@pytest.mark.parametrize("settings", [FALLING, JITTER], ids=["memory", "memory and jitter"])
def test_smoother_is_dense_least_squares(settings) -> None:
    track = falling_track(settings)
    estimate = Smoother(gravity_model(), NOWHERE, settings).estimate(track)
    assert estimate.status is Status.OK
    assert estimate.states.shape == (25, 9)
    check_same(estimate.states, estimate.covariances, *Dense(track, settings, white(track, settings), True).solve())


def test_filter_and_its_backward_pass_are_dense_least_squares() -> None:
    track = falling_track(FALLING)
    means, covariances = Dense(track, FALLING, white(track, FALLING), False).solve()
    for smooth in (False, True):
        estimate = ExtendedKalmanFilter(gravity_model(), NOWHERE, FALLING, smooth=smooth).estimate(track)
        at = slice(None) if smooth else slice(-1, None)
        assert estimate.states.shape == (25, 9)
        check_same(estimate.states[at], estimate.covariances[at], means[at], covariances[at])


def test_filter_with_jitter_is_the_textbook_kalman_filter() -> None:
    """Bias as three further states; jitter along the predicted velocity, once it is known to 1 m/s."""
    track = falling_track(JITTER)
    estimate = ExtendedKalmanFilter(gravity_model(), NOWHERE, JITTER).estimate(track)
    memory, lines = np.diag(np.square(JITTER.memory)), window_velocities(track.times, track.positions)
    H = np.concatenate((np.eye(3, 9), np.eye(3)), axis=1)

    def noise(velocity: np.ndarray) -> np.ndarray:
        return np.diag(np.square(JITTER.position_noise)) + 0.001**2 * np.outer(velocity, velocity)

    x = np.concatenate((track.positions[0], np.zeros(3), (10.0, -60.0, 20.0), np.zeros(3)))
    P = np.zeros((12, 12))
    P[:3, :3], P[3:6, 3:6], P[6:9, 6:9] = memory + noise(lines[0]), 400.0 * np.eye(3), 49.0 * np.eye(3)
    P[9:, 9:], P[:3, 9:], P[9:, :3] = memory, -memory, -memory
    states, covariances, distances = [x], [P], []
    for k, dt in enumerate(np.diff(track.times), 1):
        F, Q, decay = np.eye(12), np.zeros((12, 12)), np.exp(-dt / JITTER.memory_time)
        F[:3, 3:6], F[9:, 9:] = dt * np.eye(3), decay * np.eye(3)
        Q[:9, :9], Q[9:, 9:] = JITTER.process.flight(np.array([dt]))[0], (1.0 - decay**2) * memory
        x, P = F @ x, F @ P @ F.T + Q
        x[[2, 5]] -= G * dt**2 / 2, G * dt
        R = noise(lines[k] if np.trace(P[3:6, 3:6]) > 1.0 else x[3:6])
        S, miss = H @ P @ H.T + R, track.positions[k] - H @ x
        K = np.linalg.solve(S, H @ P).T
        distances.append(miss @ np.linalg.solve(S, miss))
        A = np.eye(12) - K @ H
        x, P = x + K @ miss, A @ P @ A.T + K @ R @ K.T
        states.append(x)
        covariances.append(P)
    check_same(estimate.states, estimate.covariances, np.array(states), np.array(covariances))
    np.testing.assert_allclose(estimate.nis[1:], distances, rtol=1e-6)


def left_out(track: Track, settings: Settings, noise: np.ndarray, wide: bool) -> np.ndarray:
    """(n,) squared whitened distance of each sample from what all others say of it, the dense problem solved anew."""
    H, found = np.concatenate((np.eye(3, 9), np.eye(3)), axis=1), []
    for k in range(len(track)):
        without = noise.copy()
        without[k] *= 1e8
        means, covariances = Dense(track, settings, without, wide).solve()
        miss = track.positions[k] - H @ means[k]
        found.append(miss @ np.linalg.solve(H @ covariances[k] @ H.T + noise[k], miss))
    return np.array(found)


def test_innovations_leave_one_sample_out() -> None:
    """To 1e-4, as without memory: `LEAST_INFORMATION` weighs most at the ends."""
    track = falling_track(FALLING)
    noise = white(track, FALLING)
    smoother = Smoother(gravity_model(), NOWHERE, FALLING).estimate(track)
    backward = ExtendedKalmanFilter(gravity_model(), NOWHERE, FALLING, smooth=True).estimate(track)
    inner = slice(1, None)  # without its own sample, the filter's first position has no prior at all
    np.testing.assert_allclose(smoother.nis, left_out(track, FALLING, noise, True), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(backward.nis[inner], left_out(track, FALLING, noise, False)[inner], rtol=1e-4, atol=1e-4)


def feed(online: Online, track: Track) -> list:
    return [online.push(t, z) for t, z in zip(track.times.tolist(), track.positions, strict=True)]


@pytest.mark.parametrize("coefficients", [False, True], ids=["model exact", "coefficients"])
@pytest.mark.parametrize("lag", [128, 6], ids=["all states", "a cut window"])
def test_online_is_dense_least_squares_at_the_newest_sample(lag, coefficients) -> None:
    """Each live answer is that of the samples so far. The spin is left out: a stream tells no label."""
    track = falling_track(FALLING)
    model = gravity_model()
    settings = replace(FALLING, coefficients={"flight.gravity.g": 1e-6} if coefficients else {})
    online = Online(model, NOWHERE, settings, lag=lag)
    for k, state in enumerate(feed(online, track)):
        part = track.until(float(track.times[k]))
        means, covariances = Dense(part, FALLING, white(part, FALLING), True).solve()
        sigma = np.sqrt(np.diag(covariances[-1]))[:6]
        assert state.covariance.shape == (9, 9)
        assert not state.rebuilt
        assert np.abs((state.state[:6] - means[-1, :6]) / sigma).max() < 1e-6
        np.testing.assert_allclose(
            state.covariance[:6, :6], covariances[-1, :6, :6], atol=1e-6 * np.outer(sigma, sigma).max()
        )
    assert (online.window.first > 0) == (lag == 6)


@pytest.mark.parametrize("settings", [FALLING, JITTER], ids=["memory", "memory and jitter"])
def test_final_states_of_online_are_dense_least_squares(settings) -> None:
    track = falling_track(settings)
    estimate = Online(gravity_model(), NOWHERE, settings).estimate(track)
    check_same(estimate.states, estimate.covariances, *Dense(track, settings, white(track, settings), True).solve())


def test_online_with_jitter_stays_near_its_final_states() -> None:
    """The live noise follows the predicted velocity, the final one line fits: a tenth of a standard deviation."""
    track = falling_track(JITTER)
    last = feed(Online(gravity_model(), NOWHERE, JITTER), track)[-1]
    means, covariances = Dense(track, JITTER, white(track, JITTER), True).solve()
    sigma = np.sqrt(np.diag(covariances[-1]))[:6]
    assert np.abs((last.state[:6] - means[-1, :6]) / sigma).max() < 0.2


def two_flights(settings: Settings) -> Track:
    """A second flight 0.9 s after the first: nothing but the tracker's bias links them."""
    first, second = falling_track(settings), falling_track(settings, seed=9)
    times = np.concatenate((first.times, second.times - second.times[0] + first.times[-1] + 0.9))
    return Track(times, np.concatenate((first.positions, second.positions)), name="two")


@pytest.mark.parametrize("coefficients", [{}, {"flight.gravity.g": 0.01}], ids=["model exact", "coefficients"])
@pytest.mark.parametrize("lag", [128, 6, 7, 8, 9])
def test_online_across_a_gap_that_nothing_links(lag, coefficients) -> None:
    """Whether the window is cut there or not, and after a repair, the newest state is the smoother's."""
    settings = replace(JITTER, find_events=True, coefficients=coefficients)
    track = two_flights(settings)
    online = Online(gravity_model(), NOWHERE, settings, lag=lag)
    states = feed(online, track)
    assert not any(state.rebuilt for state in states)
    assert not states[25].motion.linked
    expected = Smoother(gravity_model(), NOWHERE, settings).estimate(track)
    assert np.abs((states[-1].state - expected.states[-1]) / expected.sigmas[-1]).max() < 0.3
    result = online.estimate(track)
    assert np.abs((result.states[-1] - expected.states[-1]) / expected.sigmas[-1]).max() < 0.1
    np.testing.assert_allclose(result.sigmas[-1], expected.sigmas[-1], rtol=0.05)
    assert result.states.shape == (50, 9)
    assert result.cross_covariances.shape == (50, 9, len(coefficients))


@pytest.mark.parametrize("lag", [128, 6])
def test_online_after_a_repair(lag) -> None:
    track = falling_track(FALLING)
    online, undisturbed = (Online(gravity_model(), NOWHERE, FALLING, lag=lag) for _ in range(2))
    feed(undisturbed, track)
    for k, (t, z) in enumerate(zip(track.times.tolist(), track.positions, strict=True)):
        if k == 20:
            online.window.start_anew(online._samples)
        online.push(t, z)
    sigma = np.sqrt(np.diag(online.window.newest_covariance))[:9]
    assert np.abs((online.window.states[-1] - undisturbed.window.states[-1]) / sigma).max() < 1e-6
    np.testing.assert_allclose(
        online.window.newest_covariance, undisturbed.window.newest_covariance, rtol=1e-6, atol=1e-9
    )


def test_gates_know_the_whole_error() -> None:
    """30 mm of memory and 2 ms of jitter beside 2 mm of noise: no sample is an outlier, no hit is seen."""
    settings = replace(FALLING, memory=(0.03,) * 3, stamp_jitter=0.002, find_events=True)
    for seed in range(5):
        track = falling_track(settings, seed=seed)
        estimate = ExtendedKalmanFilter(gravity_model(), NOWHERE, settings).estimate(track)
        assert estimate.quality.max() == 0
        assert len(estimate.hits) == 0
        told_white = replace(settings, memory=(0.0,) * 3, stamp_jitter=0.0)
        assert ExtendedKalmanFilter(gravity_model(), NOWHERE, told_white).estimate(track).quality.max() > 0


def test_sliding_window_states_the_whole_error() -> None:
    track = falling_track(JITTER)
    estimate = SlidingWindow(gravity_model(), NOWHERE, JITTER).estimate(track)
    along = JITTER.stamp_jitter * window_velocities(track.times, track.positions)
    expected = np.sqrt(np.square(JITTER.position_noise) + np.square(JITTER.memory) + along**2)
    np.testing.assert_allclose(estimate.sigmas[:, :3], expected, rtol=1e-12)
