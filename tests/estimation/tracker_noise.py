"""Tracks as a tracker with memory and jittering stamps measures them, and the dense solution of a linear problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces
from ballfg.estimation.settings import Settings
from ballfg.factors.noise import ProcessNoise
from ballfg.tracks import Track
from tests.estimation.nees import GAUSSIAN

G = 9.81
NOWHERE = Surfaces(-1000.0)
LABEL = np.array([10.0, -60.0, 20.0])
FALLING = replace(
    GAUSSIAN,
    position_noise=(0.002, 0.003, 0.004),
    memory=(0.004, 0.003, 0.005),
    memory_time=0.03,
    process=ProcessNoise(acceleration=0.8, spin=3.0),
    spin_label_noise=7.0,
)
WIDE_SPIN, WIDE_POSITION = 2000.0, 5.0
"""rad/s and m, of the smoother's priors on the first state."""


def gravity_model() -> AnalyticModel:
    return AnalyticModel([EFFECTS["gravity"](g=G)])


def errors(times: np.ndarray, velocities: np.ndarray, settings: Settings, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) m, of measured positions: a stationary Ornstein-Uhlenbeck process, white noise, jitter of the stamps."""
    bias = np.array(settings.memory) * rng.standard_normal(3)
    lasting = [bias]
    for dt in np.diff(times):
        decay = np.exp(-dt / settings.memory_time)
        bias = decay * bias + np.sqrt(1.0 - decay**2) * np.array(settings.memory) * rng.standard_normal(3)
        lasting.append(bias)
    white = np.array(settings.position_noise) * rng.standard_normal((len(times), 3))
    return np.array(lasting) + white + settings.stamp_jitter * rng.standard_normal((len(times), 1)) * velocities


def measured_by(track: Track, states: np.ndarray, settings: Settings, seed: int) -> Track:
    """The track with positions as such a tracker measures them, along true states (n, 9)."""
    noise = errors(track.times, states[:, 3:6], settings, np.random.default_rng(seed))
    return replace(track, positions=states[:, :3] + noise)


def falling_track(settings: Settings, n: int = 25, seed: int = 4) -> Track:
    """A ball under gravity alone, frames of uneven length, one gap of 0.1 s."""
    rng = np.random.default_rng(seed)
    times = 3.0 + np.cumsum(rng.uniform(0.006, 0.014, n))
    times[n // 2 :] += 0.1
    t = times - times[0]
    states = np.zeros((n, 9))
    states[:, :3] = np.stack((5.0 * t, 0.5 * t, 2.0 + 2.0 * t - G / 2 * t**2), axis=1)
    states[:, 3:6] = np.stack((np.full(n, 5.0), np.full(n, 0.5), 2.0 - G * t), axis=1)
    labels = dict(zip(("spin_x", "spin_y", "spin_z"), LABEL.tolist(), strict=True))
    return measured_by(Track(times, states[:, :3], labels=labels, name="falling"), states, settings, seed + 1)


class Dense:
    """All states and biases of a falling ball's track as one least-squares problem, row by row.

    Args:
        track: without readings.
        settings: squared losses, no coefficients.
        noise: (n, 3, 3) m^2, covariances of the errors that are new in each sample.
        wide: whether the smoother's wide priors on the first state stand beside the label.
    """

    def __init__(self, track: Track, settings: Settings, noise: np.ndarray, wide: bool) -> None:
        self.n = len(track)
        self.rows: list[np.ndarray] = []
        self.right: list[np.ndarray] = []
        memory, eye = np.array(settings.memory), np.eye(12)
        self._add(0, eye[3:6], np.zeros(3), settings.velocity_prior**2 * np.eye(3))
        self._add(0, eye[6:9], LABEL, settings.spin_label_noise**2 * np.eye(3))
        self._add(0, eye[9:12], np.zeros(3), np.diag(memory**2))
        if wide:
            self._add(0, eye[6:9], np.zeros(3), WIDE_SPIN**2 * np.eye(3))
            self._add(0, eye[0:3], track.positions[0], WIDE_POSITION**2 * np.eye(3))
        for k in range(self.n):
            self._add(k, eye[0:3] + eye[9:12], track.positions[k], noise[k])
        for k, dt in enumerate(np.diff(track.times)):
            F, drift, Q = np.eye(12), np.zeros(12), np.zeros((12, 12))
            decay = np.exp(-dt / settings.memory_time)
            F[:3, 3:6], F[9:, 9:] = dt * np.eye(3), decay * np.eye(3)
            drift[[2, 5]] = -G * dt**2 / 2, -G * dt
            Q[:9, :9] = settings.process.flight(np.array([dt]))[0]
            Q[9:, 9:] = (1.0 - decay**2) * np.diag(memory**2)
            self._add(k, -F, drift, Q, following=eye)

    def _add(self, k: int, block: np.ndarray, right: np.ndarray, covariance: np.ndarray, following=None) -> None:
        row = np.zeros((len(block), 12 * self.n))
        row[:, 12 * k : 12 * k + 12] = block
        if following is not None:
            row[:, 12 * k + 12 : 12 * k + 24] = following
        scale = np.sqrt(np.diag(covariance))
        root = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(scale, scale))) / scale
        self.rows.append(root @ row)
        self.right.append(root @ right)

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Means (n, 12) and covariances (n, 12, 12) of states and biases."""
        A, b = np.concatenate(self.rows), np.concatenate(self.right)
        Q, R = np.linalg.qr(A)
        inverse = np.linalg.inv(R)
        whole = (inverse @ inverse.T).reshape(self.n, 12, self.n, 12)
        at = np.arange(self.n)
        return (inverse @ (Q.T @ b)).reshape(self.n, 12), whole[at, :, at, :]
