"""A stream whose ball rolls over an end of the table: errors in stated covariances, against tracks in closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray

import ballfg as bf

END, G, RADIUS, NOISE = 1.37, 9.81, 0.02, 0.0015
TABLE = bf.Surfaces(0.0, -0.76, (-END, END, -0.76, 0.76))
LONG = bf.Surfaces(0.0, -0.76, (-9.0, 9.0, -0.76, 0.76))


def rolled(speed: float, times: NDArray, leaves: float) -> NDArray:
    """(n, 9) states of a ball that passes the end of the table after `leaves` s, in a vacuum."""
    late, slows = times - leaves, 0.01 * G
    fallen = np.maximum(late, 0.0)
    states = np.zeros((len(times), 9))
    states[:, 0] = END + speed * late - slows * np.minimum(late, 0.0) ** 2 / 2.0
    states[:, 2] = RADIUS - G * fallen**2 / 2.0
    states[:, 3] = speed - slows * np.minimum(late, 0.0)
    states[:, 5] = -G * fallen
    states[:, 7] = states[:, 3] / RADIUS
    return states


def streamed(surfaces: bf.Surfaces, times: NDArray, truth: NDArray, seed: int) -> tuple[NDArray, NDArray]:
    """Errors (n, 9) and stated covariances (n, 9, 9) of the newest state of a stream."""
    settings = bf.Settings.for_measured(bf.nominal_model(), position_noise=(NOISE,) * 3, solver="ballfg")
    live, noise = bf.Online(bf.nominal_model(), surfaces, settings), np.random.default_rng(seed)
    states = [live.push(t, p + noise.normal(0.0, NOISE, 3)) for t, p in zip(times, truth[:, :3], strict=True)]
    return np.array([one.state for one in states]) - truth, np.array([one.covariance for one in states])


def distances(errors: NDArray, covariances: NDArray) -> NDArray:
    """(n,) squared errors of position and velocity in their covariances: 6 on average."""
    errors, covariances = errors[:, :6, None], covariances[:, :6, :6]
    return (errors.mT @ np.linalg.solve(covariances, errors))[:, 0, 0]


@pytest.mark.parametrize("rate", [60.0, 100.0, 250.0])
def test_a_ball_that_rolls_over_a_known_end_is_known_as_well_as_stated(rate):
    found = []
    for seed in range(6):
        leaves = 0.7 + np.random.default_rng(seed + 50).uniform() / rate
        times = np.arange(int(0.82 * rate)) / rate
        truth = rolled(0.6 + 0.2 * seed, times, leaves)
        errors, covariances = streamed(TABLE, times, truth, seed)
        first = int(np.searchsorted(times, leaves)) - 2
        found.append(distances(errors[first:], covariances[first:])[: int(0.1 * rate)])
    found = np.concatenate(found)
    assert np.median(found) < 8.0  # hundreds where the ball counts as resting until events say otherwise
    assert np.mean(found > 30.0) < 0.03
    assert found.max() < 100.0


def test_a_ball_far_from_all_ends_stays_known():
    times = np.arange(150) / 100.0
    errors, covariances = streamed(LONG, times, rolled(0.8, times, 4.0), 1)
    late = slice(80, None)
    assert np.median(covariances[late, 2, 2]) < 3e-4**2
    assert np.median(covariances[late, 5, 5]) < 0.04**2
    assert np.median(distances(errors[late], covariances[late])) < 8.0
