"""Paths: what lies between samples, kinks, gaps, and the covariance of it."""

import numpy as np
import pytest

from ballfg.vision.association.paths import MAX_GAP, Path, path

PERIOD = 1.0 / 60.0


def smooth_path(times: np.ndarray, values: np.ndarray, covariances: np.ndarray) -> Path:
    """A path that is known to have no kink."""
    return Path(times, values, covariances, np.zeros(len(times), dtype=np.int64))


def covariances(count: int, sigma: float, d: int = 2) -> np.ndarray:
    return np.tile(sigma**2 * np.eye(d), (count, 1, 1))


def curve(times: np.ndarray) -> np.ndarray:
    return np.stack((300 + 900 * times - 400 * times**2 + 300 * times**3, 500 - 700 * times + 1600 * times**2), axis=1)


def bounced(times: np.ndarray) -> np.ndarray:
    """A kink at 0.25 s: the second coordinate's velocity jumps by 2400 px/s."""
    return curve(times) + np.stack((0 * times, -2400 * np.maximum(times - 0.25, 0.0)), axis=1)


def test_cubics_come_back_exactly() -> None:
    times = np.arange(20) * PERIOD
    line = smooth_path(times, curve(times), covariances(20, 1e-6))
    asked = np.linspace(times[1], times[-2], 77)
    np.testing.assert_allclose(line.at(asked)[0], curve(asked), atol=1e-8)


def test_a_sample_is_itself() -> None:
    times = np.arange(10) * PERIOD
    values = np.random.default_rng(0).normal(size=(10, 2))
    found, spread = smooth_path(times, values, covariances(10, 0.3)).at(times)
    np.testing.assert_array_equal(found, values)
    np.testing.assert_array_equal(spread, covariances(10, 0.3))


def test_halfway_between_samples_the_variance_is_that_of_the_weights() -> None:
    """Weights -1/16, 9/16, 9/16, -1/16: the sum of their squares is 0.640625."""
    times = np.arange(10) * PERIOD
    _, spread = smooth_path(times, np.zeros((10, 2)), covariances(10, 0.3)).at(times[4:5] + PERIOD / 2)
    np.testing.assert_allclose(spread[0], 0.640625 * 0.09 * np.eye(2), rtol=1e-9, atol=1e-15)


def test_nothing_is_known_outside_and_in_long_gaps() -> None:
    times = np.concatenate((np.arange(6), np.arange(11, 17))) * PERIOD
    line = path(times, curve(times), covariances(12, 0.2))
    assert line.parts.tolist() == [0] * 6 + [1] * 6
    found, spread = line.at(np.array([-0.001, times[5] + 0.5 * MAX_GAP, times[-1] + 0.001]))
    assert np.isnan(found).all()
    assert np.isnan(spread).all()


@pytest.mark.parametrize("phase", [0.05, 0.3, 0.5, 0.7, 0.95])
def test_a_kink_is_found_and_not_smoothed_over(phase: float) -> None:
    rng = np.random.default_rng(3)
    times = 0.25 + (np.arange(-10, 11) - phase) * PERIOD
    line = path(times, bounced(times) + 0.2 * rng.standard_normal((21, 2)), covariances(21, 0.2))
    assert line.parts[-1] == 1
    assert abs(np.flatnonzero(np.diff(line.parts))[0] - 10) <= 1  # at a sample next to the kink either side is right
    asked = np.linspace(times[2], times[-3], 200)
    found, spread = line.at(asked)
    apart = found - bounced(asked)
    square = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(spread), apart)
    assert np.sqrt((apart**2).mean()) < 1.0  # one cubic would be off by five
    assert square.mean() < 8.0


def test_noise_alone_makes_no_kinks() -> None:
    times = np.arange(3000) * PERIOD
    values = 0.2 * np.random.default_rng(0).standard_normal((3000, 2))
    assert path(times, values, covariances(3000, 0.2)).parts[-1] <= 1


def test_covariance_holds_between_unlike_samples() -> None:
    """Mean squared whitened error of 2 coordinates: 2, with a standard deviation of sqrt(4 / n)."""
    rng = np.random.default_rng(1)
    times = np.sort(np.arange(800) * PERIOD / 2 + rng.uniform(0, 0.3 * PERIOD, 800))[rng.random(800) > 0.1]
    asked = rng.uniform(times[2], times[-3], 2000)
    true = np.stack((100 * np.sin(3 * asked), 80 * np.cos(4 * asked)), axis=1)
    values = np.stack((100 * np.sin(3 * times), 80 * np.cos(4 * times)), axis=1)
    line = smooth_path(times, values + 0.3 * rng.standard_normal(values.shape), covariances(len(times), 0.3))
    found, spread = line.at(asked)
    square = np.einsum("ni,nij,nj->n", found - true, np.linalg.inv(spread), found - true)
    assert 1.7 < square.mean() < 2.2


def test_short_paths() -> None:
    one = path(np.zeros(1), np.ones((1, 2)), covariances(1, 0.2))
    assert np.isnan(one.at(np.zeros(1))[0]).all()
    two = path(np.array([0.0, PERIOD]), np.array([[0.0, 0.0], [1.0, 2.0]]), covariances(2, 0.2))
    found, spread = two.at(np.array([PERIOD / 2]))
    np.testing.assert_allclose(found, [[0.5, 1.0]])
    assert spread[0, 0, 0] > 0.02  # half the variance, and what a straight line leaves out
