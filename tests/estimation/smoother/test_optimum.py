"""One optimum: the smoother against scipy on the same objective, written here once more in plain numpy.

Nothing of ballfg's dynamics, factors or noise is used for the reference: flight is a Runge-Kutta of its own, the
contact time a root, the impact the law of docs/derivations/impact.md, derivatives are differences. What both share is
given: the measurements, the numbers of `Settings` and of the model file, and which interval holds which contact.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares

from ballfg.dynamics import nominal_model
from ballfg.estimation.smoother.problem import effective_sigmas
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.graph import LevenbergMarquardt
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, MotionNoise as TrueNoise, SimulationConfig, simulate
from ballfg.tracks import Track
from tests.estimation.nees import GAUSSIAN

G, DRAG, MAGNUS, E, MU, E_T, OFFSET, RADIUS, SHELL = 9.81, 0.12, 0.0028, 0.93, 0.25, 0.15, -0.003, 0.02, 2 / 3
Q_ACCELERATION, Q_SPIN, KICK_VELOCITY, KICK_SPIN = 0.2, 2.0, 0.03, 6.0
SIGMA, LABEL_SIGMA, VELOCITY_SIGMA, POSITION_SIGMA, WIDE_SPIN = 0.003, 4.0, 20.0, 5.0, 2000.0
LONGEST_STEP = 0.02


def flow(state: np.ndarray, dt: float) -> np.ndarray:
    """Runge-Kutta of order four in equal steps of at most 20 ms."""

    def rate(s: np.ndarray) -> np.ndarray:
        v, w = s[3:6], s[6:9]
        force = np.array((0.0, 0.0, -G)) - DRAG * np.sqrt(v @ v) * v
        lift = MAGNUS * np.array((w[1] * v[2] - w[2] * v[1], w[2] * v[0] - w[0] * v[2], w[0] * v[1] - w[1] * v[0]))
        return np.concatenate((v, force + lift, np.zeros(3)))

    steps = max(1, int(np.ceil(abs(dt) / LONGEST_STEP)))
    h = dt / steps
    for _ in range(steps):
        k1 = rate(state)
        k2 = rate(state + h / 2 * k1)
        k3 = rate(state + h / 2 * k2)
        k4 = rate(state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state


def impact(state: np.ndarray) -> np.ndarray:
    """Slide or grip of a thin shell, rounded off over a tenth of the gripping impulse."""
    v, w = state[3:6], state[6:9]
    slip = np.array((v[0] - RADIUS * w[1], v[1] + RADIUS * w[0]))
    grip = SHELL / (1 + SHELL) * (1 + E_T)
    slide = MU * (1 + E) * -v[2] / np.sqrt(slip @ slip)
    share, width = min(slide, grip), 0.1 * grip
    if abs(slide - grip) < width:
        share -= (width - abs(slide - grip)) ** 2 / (4 * width)
    push = -share * slip
    after = state.copy()
    after[3:5] += push
    after[5] = -E * v[2]
    after[6:8] += np.array((push[1], -push[0])) / (SHELL * RADIUS)
    return after


def through(state: np.ndarray, dt: float, height: float) -> np.ndarray:
    level = height + OFFSET + RADIUS

    def gap(t: float) -> float:
        return float(flow(state, t)[2]) - level

    reach = 2e-3  # the root lies where the ball moves down; widen around a straight fall until it changes sign
    guess = (state[2] - level) / max(-state[5], 0.1)
    while gap(guess - reach) <= 0.0 or gap(guess + reach) >= 0.0:
        reach *= 1.5
    time = brentq(gap, guess - reach, guess + reach, xtol=1e-15, rtol=4 * np.finfo(float).eps)
    return flow(impact(flow(state, time)), dt - time)


def noise(dt: float, kick: float | None) -> np.ndarray:
    covariance = np.zeros((9, 9))
    for i in range(3):
        covariance[i, i] = Q_ACCELERATION**2 * dt**3 / 3
        covariance[i, 3 + i] = covariance[3 + i, i] = Q_ACCELERATION**2 * dt**2 / 2
        covariance[3 + i, 3 + i] = Q_ACCELERATION**2 * dt
        covariance[6 + i, 6 + i] = Q_SPIN**2 * dt
        if kick is not None:  # how long before the end of the interval
            reach = np.array((kick, 1.0)) * KICK_VELOCITY
            covariance[np.ix_((i, 3 + i), (i, 3 + i))] += np.outer(reach, reach)
            covariance[6 + i, 6 + i] += KICK_SPIN**2
    return covariance


class Reference:
    """The whole objective as a residual vector, with a Jacobian from five-point differences interval by interval."""

    def __init__(self, track: Track, contacts) -> None:
        self.track, self.n = track, len(track)
        self.dt = np.diff(track.times)
        self.contacts = {c.interval: c for c in contacts}
        self.roots = []
        for i, dt in enumerate(self.dt):
            left = None
            if i in self.contacts:  # the kick's time counts in 64ths of its interval
                share = round((self.contacts[i].time - track.times[i]) / dt * 64) / 64
                left = float(np.clip((1.0 - share) * dt, 0.0, dt))
            self.roots.append(np.linalg.inv(np.linalg.cholesky(noise(dt, left))))
        self.prior_mean = np.concatenate((track.positions[0], np.zeros(6)))
        self.prior_sigma = np.repeat((POSITION_SIGMA, VELOCITY_SIGMA, WIDE_SPIN), 3)

    def motion(self, i: int, state: np.ndarray) -> np.ndarray:
        if i in self.contacts:
            return through(state, self.dt[i], self.contacts[i].height)
        return flow(state, self.dt[i])

    def residual(self, x: np.ndarray) -> np.ndarray:
        states = x.reshape(self.n, 9)
        parts = [((states[:, :3] - self.track.positions) / SIGMA).ravel()]
        parts += [self.roots[i] @ (states[i + 1] - self.motion(i, states[i])) for i in range(self.n - 1)]
        parts.append((states[0] - self.prior_mean) / self.prior_sigma)
        parts.append((states[0, 6:] - self.track.spin_label) / LABEL_SIGMA)
        return np.concatenate(parts)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        n, states = self.n, x.reshape(self.n, 9)
        J = np.zeros((3 * n + 9 * (n - 1) + 12, 9 * n))
        for i in range(n):
            J[3 * i : 3 * i + 3, 9 * i : 9 * i + 3] = np.eye(3) / SIGMA
        steps = np.repeat((1e-3, 1e-3, 1e-1), 3)
        for i in range(n - 1):
            rows = slice(3 * n + 9 * i, 3 * n + 9 * i + 9)
            for j, h in enumerate(steps):
                unit = h * np.eye(9)[j]
                near = self.motion(i, states[i] + unit) - self.motion(i, states[i] - unit)
                J[rows, 9 * i + j] = -self.roots[i] @ near / (2 * h)
            J[rows, 9 * i + 9 : 9 * i + 18] = self.roots[i]
        J[-12:-3, :9] = np.diag(1 / self.prior_sigma)
        J[-3:, 6:9] = np.eye(3) / LABEL_SIGMA
        return J


CONFIG = SimulationConfig(
    tracks=3,
    rate=60.0,
    seed=21,
    noise=MeasurementNoise(position=SIGMA, spin=LABEL_SIGMA, dropout=0.05),
    process=TrueNoise(Q_ACCELERATION, Q_SPIN, KICK_VELOCITY, KICK_SPIN),
)
SETTINGS = replace(
    GAUSSIAN,
    position_noise=(SIGMA,) * 3,
    process=ProcessNoise(Q_ACCELERATION, Q_SPIN, KICK_VELOCITY, contact_spin=KICK_SPIN),
    spin_label_noise=LABEL_SIGMA,
    velocity_prior=VELOCITY_SIGMA,
)


@pytest.fixture(scope="module")
def solved():
    """The smoother's estimate and solution, a solution to a tighter tolerance, scipy's minimum and objective.

    Scipy starts some 0.5 mm, 0.05 m/s, 5 rad/s away, at every state by itself.
    """
    smoother = Smoother(nominal_model(), CONFIG.ball.surfaces, SETTINGS)
    tight = Smoother(nominal_model(), CONFIG.ball.surfaces, SETTINGS, LevenbergMarquardt(tolerance=1e-7))
    results = []
    rng = np.random.default_rng(0)
    for simulated in simulate(CONFIG):
        track = simulated.track
        segmentation = smoother.segment(track)
        sigma = effective_sigmas(track, segmentation, SETTINGS)
        solution, closer = (
            smoother.settle(smoother.problem(track, segmentation, sigma)),
            tight.settle(tight.problem(track, segmentation, sigma)),
        )
        reference = Reference(track, solution.events.contacts)
        start = solution.minimum.values.states + np.repeat((5e-4, 5e-2, 5.0), 3) * rng.standard_normal((len(track), 9))
        scale = np.tile(np.repeat((SIGMA, 0.1, 5.0), 3), len(track))
        found = least_squares(
            lambda u, scale=scale, reference=reference: reference.residual(u * scale),
            start.ravel() / scale,
            jac=lambda u, scale=scale, reference=reference: reference.jacobian(u * scale) * scale,
            method="trf",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-10,
            max_nfev=60,
        )
        results.append((smoother.estimate(track), solution, closer, (found.x * scale).reshape(-1, 9), found.cost))
    return results


def test_every_track_bounces(solved) -> None:
    assert all(len(solution.events.contacts) >= 1 for _, solution, _, _, _ in solved)


def test_same_minimum(solved) -> None:
    """Required: 1e-6 m and 1e-5 m/s. Spin follows to 1e-3 rad/s, 2e-4 of its label's sigma."""
    off = np.array([np.abs(estimate.states - x).max(axis=0) for estimate, _, _, x, _ in solved])
    print(f"{len(solved)} tracks: {off[:, :3].max():.1e} m, {off[:, 3:6].max():.1e} m/s, {off[:, 6:].max():.1e} rad/s")
    assert off[:, :3].max() < 1e-6
    assert off[:, 3:6].max() < 1e-5
    assert off[:, 6:].max() < 1e-3


def test_a_tighter_tolerance_comes_closer(solved) -> None:
    """The same function is being minimised: nothing but scipy's own tolerance and rounding are left."""
    off = np.array([np.abs(closer.minimum.values.states - x).max(axis=0) for _, _, closer, x, _ in solved])
    assert off[:, :3].max() < 1e-8
    assert off[:, 3:6].max() < 1e-7
    assert off[:, 6:].max() < 1e-5


def test_same_objective(solved) -> None:
    for estimate, solution, closer, _, cost in solved:
        assert estimate.error == pytest.approx(solution.minimum.error, rel=1e-12)
        assert estimate.error == pytest.approx(cost, rel=1e-7)
        assert closer.minimum.error == pytest.approx(cost, rel=1e-9)
        assert estimate.status.name == "OK"
