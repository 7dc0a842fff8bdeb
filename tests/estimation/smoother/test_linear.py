"""A linear problem: the smoother is Kalman filter and Rauch-Tung-Striebel pass, and leave-one-out is what it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces, nominal_model
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.problem import effective_sigmas
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, LevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.factors.position import PositionFactors
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate
from ballfg.tracks import Track
from tests.estimation.nees import GAUSSIAN

G = 9.81
NOWHERE = Surfaces(-1000.0)
NOISE = ProcessNoise(acceleration=0.8, spin=3.0)
LABEL = np.array([10.0, -60.0, 20.0])
PLAIN = replace(
    GAUSSIAN,
    position_noise=(0.002, 0.003, 0.004),
    process=NOISE,
    spin_label_noise=7.0,
)


def falling_track(n: int = 25, seed: int = 4) -> Track:
    """A ball under gravity alone, frames of uneven length, one gap of 0.1 s."""
    rng = np.random.default_rng(seed)
    times = 3.0 + np.cumsum(rng.uniform(0.006, 0.014, n))
    times[n // 2 :] += 0.1
    t = times - times[0]
    positions = np.stack((5.0 * t, 0.5 * t, 2.0 + 2.0 * t - G / 2 * t**2), axis=1)
    positions += rng.standard_normal((n, 3)) * PLAIN.position_noise
    labels = dict(zip(("spin_x", "spin_y", "spin_z"), LABEL.tolist(), strict=True))
    return Track(times, positions, labels=labels, name="falling")


def kalman_rts(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """Means (n, 9) and covariances (n, 9, 9), textbook form; Joseph form in the update for the sake of the digits."""
    n = len(track)
    H, R = np.eye(3, 9), np.diag(np.square(PLAIN.position_noise))
    label, wide = 1 / PLAIN.spin_label_noise**2, 1 / 2000.0**2  # of the label and of the wide prior about zero
    x = np.concatenate((track.positions[0], np.zeros(3), LABEL * label / (label + wide)))
    P = np.diag(np.repeat((25.0, PLAIN.velocity_prior**2, 1 / (label + wide)), 3))
    filtered, predicted = [], []
    for k in range(n):
        if k:
            dt = track.times[k] - track.times[k - 1]
            F = np.eye(9)
            F[:3, 3:6] = dt * np.eye(3)
            x = F @ x
            x[2] -= G * dt**2 / 2
            x[5] -= G * dt
            P = F @ P @ F.T + NOISE.flight(np.array([dt]))[0]
            predicted.append((x, P, F))
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        x = x + K @ (track.positions[k] - H @ x)
        A = np.eye(9) - K @ H
        P = A @ P @ A.T + K @ R @ K.T
        filtered.append((x, P))
    means, covariances = [x], [P]
    for (x_k, P_k), (x_next, P_next, F) in zip(filtered[-2::-1], predicted[::-1], strict=True):
        C = np.linalg.solve(P_next, F @ P_k).T
        means.append(x_k + C @ (means[-1] - x_next))
        A = np.eye(9) - C @ F
        Q = P_next - F @ P_k @ F.T
        covariances.append(A @ P_k @ A.T + C @ (covariances[-1] + Q) @ C.T)
    return np.array(means[::-1]), np.array(covariances[::-1])


@pytest.fixture(scope="module")
def gravity_model() -> AnalyticModel:
    return AnalyticModel([EFFECTS["gravity"](g=G)])


def test_smoother_is_kalman_and_rts(gravity_model) -> None:
    """1e-8 of a standard deviation, and of the covariances in these units."""
    track = falling_track()
    estimate = Smoother(gravity_model, NOWHERE, PLAIN).estimate(track)
    means, covariances = kalman_rts(track)
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    assert estimate.status is Status.OK
    assert np.abs((estimate.states - means) / sigma).max() < 1e-8
    unit = sigma[:, :, None] * sigma[:, None, :]
    assert np.abs((estimate.covariances - covariances) / unit).max() < 1e-8
    np.testing.assert_allclose(estimate.sigmas, sigma, rtol=1e-8)


def test_newton_needs_one_step(gravity_model) -> None:
    """One step to the minimum, one linearisation that finds itself there."""
    assert Smoother(gravity_model, NOWHERE, PLAIN).estimate(falling_track()).iterations == 2


def brute_force(model, surfaces: Surfaces, settings: Settings, track: Track, samples) -> np.ndarray:
    """(k, 3) whitened innovations: the sample's factor deleted, the rest minimised anew, the sample predicted."""
    smoother = Smoother(model, surfaces, settings)
    segmentation = smoother.segment(track)
    sigma = effective_sigmas(track, segmentation, settings)
    solution = smoother.settle(smoother.problem(track, segmentation, sigma))
    graph = smoother.problem(track, segmentation, sigma).graph(solution.events)
    whitened = []
    for k in samples:
        others = np.delete(np.arange(len(track)), k)
        kept = PositionFactors(others, track.positions[others], sigma[others], settings.loss)
        minimum = LevenbergMarquardt().minimize(BallGraph((kept, *graph.batches[1:])), solution.minimum.values)
        C = _position_covariance(minimum.step, k)
        root = np.linalg.cholesky(C + np.diag(sigma[k] ** 2))
        whitened.append(np.linalg.solve(root, track.positions[k] - minimum.values.states[k, :3]))
    return np.array(whitened)


def _position_covariance(step, k: int) -> np.ndarray:
    """From the dense inverse of the whole R."""
    n = len(step.root.states)
    R = np.zeros((9 * n, 9 * n))
    for i, rows in enumerate(step.root.states):
        R[9 * i : 9 * i + 9, 9 * i : 9 * i + 18] = rows[:, : min(18, 9 * (n - i))]
    inverse = np.linalg.inv(R)
    return (inverse @ inverse.T)[9 * k : 9 * k + 3, 9 * k : 9 * k + 3]


def test_leave_one_out_on_a_linear_problem(gravity_model) -> None:
    """Exact but for `LEAST_INFORMATION` (1e-6 of the posterior's), which weighs most at the ends: 1e-4."""
    track = falling_track()
    estimate = Smoother(gravity_model, NOWHERE, PLAIN).estimate(track)
    expected = brute_force(gravity_model, NOWHERE, PLAIN, track, range(len(track)))
    np.testing.assert_allclose(estimate.whitened, expected, atol=1e-4)
    np.testing.assert_allclose(estimate.nis, (estimate.whitened**2).sum(axis=1))


def test_leave_one_out_with_huber(gravity_model) -> None:
    """A sample in the loss's tail: its weight is a linearisation, so to 2 % of what is predicted, and 0.02 sigma."""
    track = falling_track()
    track.positions[7, 1] += 0.025  # 8 sigma
    settings = Settings(**{**vars(PLAIN), "loss": Loss("huber", 2.0)})
    estimate = Smoother(gravity_model, NOWHERE, settings).estimate(track)
    expected = brute_force(gravity_model, NOWHERE, settings, track, range(len(track)))
    assert np.linalg.norm(expected[7]) > 6.0
    np.testing.assert_allclose(estimate.whitened, expected, rtol=0.02, atol=0.02)


def test_leave_one_out_through_a_bounce() -> None:
    """Not linear: the others' estimate moves by a part of a sigma, over which the contact bends little: 0.03."""
    config = SimulationConfig(tracks=1, rate=50.0, seed=21, noise=MeasurementNoise(position=0.003, spin=4.0))
    track = next(simulate(config)).track
    settings = Settings(**{**vars(PLAIN), "position_noise": (0.003,) * 3, "spin_label_noise": 4.0})
    estimate = Smoother(nominal_model(), config.ball.surfaces, settings).estimate(track)
    contact = estimate.contacts[0].interval
    samples = [0, 1, contact - 1, contact, contact + 1, contact + 2, len(track) - 1]
    expected = brute_force(nominal_model(), config.ball.surfaces, settings, track, samples)
    np.testing.assert_allclose(estimate.whitened[samples], expected, atol=0.03)


def test_order_of_factors_does_not_matter(gravity_model) -> None:
    """Another order rounds differently: 1e-9 of a standard deviation, times what QR loses at condition 1e4."""
    track = falling_track()
    smoother = Smoother(gravity_model, NOWHERE, PLAIN)
    segmentation = smoother.segment(track)
    solution = smoother.settle(smoother.problem(track, segmentation))
    start = Values(solution.minimum.values.states + 0.01, np.zeros(0))
    optimizer = LevenbergMarquardt()
    forward = optimizer.minimize(solution.graph, start)
    backward = optimizer.minimize(BallGraph(solution.graph.batches[::-1]), start)
    sigma = smoother.estimate(track).sigmas
    assert np.abs((forward.values.states - backward.values.states) / sigma).max() < 1e-7
    assert forward.error == pytest.approx(backward.error, rel=1e-10)
