"""Simulated flights with readings of a radar and of spins, and dense least squares as another route to their states."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces
from ballfg.estimation import RadarSpeed, SpinReading
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.tracks import Track
from tests.estimation.nees import GAUSSIAN

G = 9.81
NOWHERE = Surfaces(-1000.0)
NOISE = ProcessNoise(acceleration=0.5, spin=3.0)
SIGMA, SPEED_SIGMA = 0.004, 0.05
PLAIN = replace(
    GAUSSIAN,
    position_noise=(SIGMA,) * 3,
    process=NOISE,
    spin_prior=60.0,
    velocity_prior=20.0,
)
"""Everything Gaussian, so that all estimators are told the same."""
START = np.array([0.0, 0.0, 1.0, 5.0, -1.0, 3.0, 20.0, 60.0, -10.0])


class PlainSpeed(RadarSpeed):
    """A radar without outliers."""

    loss: ClassVar[Loss] = Loss()


class PlainSpin(SpinReading):
    """A reader of spins without outliers."""

    loss: ClassVar[Loss] = Loss()


def gravity_model() -> AnalyticModel:
    """A ball under gravity alone: flight is linear."""
    return AnalyticModel([EFFECTS["gravity"](g=G)])


def flown(x: Array, dt: float) -> Array:
    """(9,) the state after dt under gravity."""
    x = x.copy()
    x[:3] += dt * x[3:6]
    x[2] -= G * dt**2 / 2
    x[5] -= G * dt
    return x


def flight(seed: int, samples: int = 20, start: Array = START) -> tuple[Track, Array, np.random.Generator]:
    """A track under gravity with noise exactly as `PLAIN` declares it, stamps of uneven length; its truth (n, 9)."""
    rng = np.random.default_rng(seed)
    times = 2.0 + np.cumsum(rng.uniform(0.006, 0.014, samples))
    truth = [start + np.concatenate((np.zeros(6), 0.3 * rng.standard_normal(3)))]
    for dt in np.diff(times):
        kick = rng.multivariate_normal(np.zeros(9), NOISE.flight(np.array([dt]))[0], method="eigh")
        truth.append(flown(truth[-1], dt) + kick)
    states = np.array(truth)
    track = Track(times, states[:, :3] + SIGMA * rng.standard_normal((samples, 3)), name=f"flight {seed}")
    return track, states, rng


def with_speeds(seed: int, every: int = 1, delay: float = 0.0, samples: int = 20, bias: float = 0.0) -> Track:
    """A flight with speeds at every so many samples, the last one included, read `delay` seconds after the stamp."""
    track, truth, rng = flight(seed, samples)
    at = np.arange(samples - 1, 0, -every)[::-1]
    speeds = [np.linalg.norm(flown(truth[k], delay)[3:6]) for k in at]
    measured = np.array(speeds) + bias + SPEED_SIGMA * rng.standard_normal(len(at))
    return track.observed(PlainSpeed(at, measured, SPEED_SIGMA, np.full(len(at), delay)))


def without(track: Track) -> Track:
    """The positions alone."""
    return replace(track, observations=())


def dense(track: Track, bias_sigma: float | None = None) -> tuple[Array, Array, Array]:
    """States (n, 9), covariances (n, 9, 9) and (bias, its sigma) by Gauss-Newton on one dense matrix."""
    n = len(track)
    (speeds,) = track.observations
    width = 9 * n + (bias_sigma is not None)
    wide = np.concatenate((np.full(3, 1 / 5.0), np.full(3, 1 / 20.0), np.full(3, np.hypot(1 / 60.0, 1 / 2000.0))))
    about = np.concatenate((track.positions[0], np.zeros(6)))
    roots = [np.linalg.inv(np.linalg.cholesky(NOISE.flight(np.array([dt]))[0])) for dt in np.diff(track.times)]
    x = np.zeros(width)
    x[: 9 * n] = np.concatenate([flown(START, t - track.times[0]) for t in track.times])
    for _ in range(30):
        states = x[: 9 * n].reshape(n, 9)
        rows, residuals = [], []

        def add(block: Array, residual: Array, state: int, rows: list = rows, residuals: list = residuals) -> None:
            row = np.zeros((len(residual), width))
            row[:, 9 * state : 9 * state + block.shape[1]] = block
            rows.append(row)
            residuals.append(residual)

        add(np.diag(wide), wide * (states[0] - about), 0)
        for k in range(n):
            add(np.eye(3, 9) / SIGMA, (states[k, :3] - track.positions[k]) / SIGMA, k)
        for k, dt in enumerate(np.diff(track.times)):
            F = np.eye(9)
            F[:3, 3:6] = dt * np.eye(3)
            add(np.hstack((-roots[k] @ F, roots[k])), roots[k] @ (states[k + 1] - flown(states[k], dt)), k)
        for k, value, delay in zip(speeds.state, speeds.values[:, 0], speeds.delay, strict=True):
            velocity = flown(states[k], delay)[3:6]
            speed = np.linalg.norm(velocity)
            block = np.zeros((1, 9))
            block[0, 3:6] = velocity / speed / SPEED_SIGMA
            bias = 0.0 if bias_sigma is None else x[-1]
            add(block, np.array([(speed + bias - value) / SPEED_SIGMA]), int(k))
            if bias_sigma is not None:
                rows[-1][0, -1] = 1 / SPEED_SIGMA
        if bias_sigma is not None:
            rows.append(np.eye(1, width, width - 1) / bias_sigma)
            residuals.append(x[-1:] / bias_sigma)
        J, r = np.vstack(rows), np.concatenate(residuals)
        step = np.linalg.lstsq(J, -r, rcond=None)[0]
        x += step
    R = np.linalg.qr(J, mode="r")
    inverse = np.linalg.inv(R)
    covariance = inverse @ inverse.T
    blocks = np.array([covariance[9 * k : 9 * k + 9, 9 * k : 9 * k + 9] for k in range(n)])
    return x[: 9 * n].reshape(n, 9), blocks, np.array([x[-1], np.sqrt(covariance[-1, -1])])
