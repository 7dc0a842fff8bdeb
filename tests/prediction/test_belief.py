"""A coefficient out of its bounds is held on them, and the rest follows as a normal distribution does."""

from __future__ import annotations

import numpy as np

from ballfg.prediction.belief import _held


def test_the_rest_goes_where_the_density_on_the_bound_is_highest() -> None:
    """Against the least-squares solution with the coefficient fixed, from the inverse of the covariance."""
    rng = np.random.default_rng(3)
    root, mean = rng.normal(size=(11, 11)), rng.normal(size=11)
    covariance, free = root @ root.T, np.arange(10)
    mean[9], mean[10] = 0.5, -0.3
    held = _held(mean, covariance, np.array([0.0, 0.0]), np.array([1.0, 1.0]))
    precision, fixed = np.linalg.inv(covariance), 10
    expected = mean[free] - np.linalg.solve(precision[np.ix_(free, free)], precision[free, fixed] * (0.0 - mean[fixed]))
    assert held[fixed] == 0.0
    np.testing.assert_allclose(held[:9], expected[:9], rtol=1e-9)
    np.testing.assert_allclose(held[9], np.clip(expected[9], 0.0, 1.0), rtol=1e-9)


def test_a_mean_within_its_bounds_stays() -> None:
    mean = np.arange(11.0) / 11.0
    assert _held(mean, np.eye(11), np.zeros(2), np.ones(2)) is mean
