import numpy as np
import pytest

from ballfg.benchmarks.gaussian_settings import StepNoise
from ballfg.benchmarks.metrics import (
    bootstrap,
    chi_square_band,
    inside,
    median_and_range,
    nees,
    pooled_mean,
    pooled_rms,
    quantile,
    ratio,
    share,
    square_norms,
)


def test_pooled_rms_weighs_tracks_by_their_samples() -> None:
    # track 0: errors 3, 4 (squares 9 + 16); track 1: one error 5: sqrt(50 / 3)
    statistic = pooled_rms([25.0, 25.0], [2.0, 1.0])
    assert statistic(np.array([[0, 1]]))[0] == pytest.approx(np.sqrt(50 / 3))
    assert statistic(np.array([[0, 0], [1, 1]])).tolist() == pytest.approx([np.sqrt(12.5), 5.0])


def test_ratio_uses_the_same_resample_for_both() -> None:
    sums = np.array([1.0, 100.0, 10000.0])
    twice = ratio(pooled_rms(4 * sums, np.ones(3)), pooled_rms(sums, np.ones(3)))
    figure = bootstrap(twice, 3, np.random.default_rng(0))
    assert (figure.value, figure.low, figure.high) == pytest.approx((2.0, 2.0, 2.0))


def test_nees_of_draws_from_the_covariance_lies_in_the_band() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((9, 9))
    errors = rng.standard_normal((2000, 9)) @ root.T
    values = nees(errors, np.broadcast_to(root @ root.T, (2000, 9, 9)))
    low, high = chi_square_band(9, 2000)
    assert low < values.mean() < high
    assert (low, high) == pytest.approx((9 - 2.576 * np.sqrt(18 / 2000), 9 + 2.576 * np.sqrt(18 / 2000)), abs=0.01)


def test_nees_by_hand() -> None:
    assert nees(np.array([[1.0, 2.0]]), np.array([[[4.0, 0.0], [0.0, 0.25]]])) == pytest.approx([0.25 + 16.0])


def test_square_norms() -> None:
    assert square_norms(np.array([[3.0, 4.0], [0.0, 0.0]])).tolist() == [25.0, 0.0]


def test_inside_is_the_central_interval() -> None:
    errors = np.array([0.67, 0.68, -1.64, -1.65])
    assert inside(errors, np.ones(4), 0.5).tolist() == [True, False, False, False]
    assert inside(errors, np.ones(4), 0.9).tolist() == [True, True, True, False]


def test_bootstrap_interval_has_the_width_of_the_standard_error() -> None:
    values = np.random.default_rng(1).standard_normal(400)
    figure = bootstrap(pooled_mean(values, np.ones(400)), 400, np.random.default_rng(2))
    assert figure.value == pytest.approx(values.mean())
    assert figure.high - figure.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.15)


def test_bootstrap_repeats_with_its_seed() -> None:
    statistic = quantile(np.arange(30.0), 0.5)
    one, two = (bootstrap(statistic, 30, np.random.default_rng(7)) for _ in range(2))
    assert one == two
    assert one.value == 14.5


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one track"):
        bootstrap(pooled_mean([], []), 0, np.random.default_rng(0))


def test_share_has_wilsons_interval() -> None:
    figure = share([True] * 9 + [False])
    assert figure.value == 0.9
    # E. B. Wilson 1927: (p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)
    z, n, p = 1.959964, 10, 0.9
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    low, high = (p + z**2 / (2 * n) + sign * half for sign in (-1, 1))
    assert (figure.low, figure.high) == pytest.approx((low / (1 + z**2 / n), high / (1 + z**2 / n)), rel=1e-6)
    with pytest.raises(ValueError, match="outcomes must not be empty"):
        share([])


def test_median_stands_between_the_extremes() -> None:
    figure = median_and_range([1.0, 3.0, 2.0, np.inf])
    assert (figure.value, figure.low, figure.high) == (2.5, 1.0, np.inf)
    with pytest.raises(ValueError, match="values must not be empty"):
        median_and_range([])


def test_step_noise_does_not_depend_on_the_step_but_for_spin() -> None:
    covariance = StepNoise(spin=2.0, step_position=0.1, step_velocity=0.3).flight(np.array([0.01, 0.04]))
    expected = np.diag([0.01] * 3 + [0.09] * 3 + [0.04] * 3)
    np.testing.assert_allclose(covariance[0], expected)
    expected[6:, 6:] *= 4
    np.testing.assert_allclose(covariance[1], expected)
