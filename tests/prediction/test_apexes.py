"""Apexes and path errors against parabolas, whose apex is known in closed form."""

from itertools import pairwise

import numpy as np
import pytest

from ballfg.benchmarks.dynamics.task import TaskShot, apex_errors, pooled_rmse, score_path
from ballfg.prediction.apexes import flight_bounds, measured_apexes, path_apex, true_apexes
from ballfg.tracks import Track

G = 9.81
RATE = 120.0
STARTS = (0.0, 0.4, 1.0, 1.5)
"""s, of the flights; the last two numbers bound the third."""


def hop(times: np.ndarray, start: float, end: float) -> np.ndarray:
    """(n, 9) a flight in vacuum from the ground at `start` to the ground at `end`."""
    s, up = times - start, G * (end - start) / 2
    states = np.zeros((len(times), 9))
    states[:, 0], states[:, 1], states[:, 2] = 2.0 * times, -0.5 * times, up * s - G * s**2 / 2
    states[:, 3:6] = np.stack((np.full(len(s), 2.0), np.full(len(s), -0.5), up - G * s), axis=-1)
    return states


@pytest.fixture
def hops() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, states, bounces and apexes of three hops, at stamps that meet no apex."""
    times = np.arange(0.0011, STARTS[-1], 1 / RATE)
    states = np.zeros((len(times), 9))
    for start, end in pairwise(STARTS):
        rows = (times >= start) & (times < end)
        states[rows] = hop(times[rows], start, end)
    middle = (np.array(STARTS[:-1]) + STARTS[1:]) / 2
    heights = G * np.diff(STARTS) ** 2 / 8
    return times, states, np.array(STARTS[1:-1]), np.stack((2.0 * middle, -0.5 * middle, heights), axis=-1)


def test_true_apexes_are_those_of_the_parabolas(hops) -> None:  # type: ignore[no-untyped-def]
    times, states, bounces, expected = hops
    points, when = true_apexes(times, states, bounces)
    np.testing.assert_allclose(points, expected, atol=1e-12)
    np.testing.assert_allclose(when, (np.array(STARTS[:-1]) + STARTS[1:]) / 2, atol=1e-12)


def test_a_true_apex_against_drag_is_that_of_the_closed_form() -> None:
    """Only the two frames about the top tell it: the motion is no cubic elsewhere."""
    k, up = 0.8, 2.0
    times = np.arange(0.0011, 0.5, 1 / RATE)
    states, fade = np.zeros((len(times), 9)), np.exp(-k * times)
    states[:, 2] = (up + G / k) * (1 - fade) / k - G * times / k
    states[:, 5] = (up + G / k) * fade - G / k
    top = np.log(1 + k * up / G) / k
    points, when = true_apexes(times, states, np.zeros(0))
    assert when[0] == pytest.approx(top, abs=1e-7)
    assert points[0, 2] == pytest.approx(up / k - G * top / k, abs=1e-9)


def test_apexes_of_positions_alone_are_the_same(hops) -> None:  # type: ignore[no-untyped-def]
    times, states, bounces, expected = hops
    points, _ = measured_apexes(times, states[:, :3], bounces)
    np.testing.assert_allclose(points, expected, atol=1e-10)


def test_noise_on_a_measured_apex_is_averaged_as_least_squares_does() -> None:
    times = np.arange(-12, 13) / RATE
    rng = np.random.default_rng(0)
    paths = hop(times, -0.3, 0.3)[:, :3] + 0.003 * rng.standard_normal((400, len(times), 3))
    heights = np.array([path_apex(times, path, -0.1, 0.1)[0][2] for path in paths])
    design = np.vander(times[np.abs(times) <= 0.05], 3)  # same window, seen from the middle
    expected = 0.003 * np.sqrt(np.linalg.inv(design.T @ design)[2, 2])
    assert heights.std() == pytest.approx(expected, rel=0.15)
    assert abs(heights.mean() - G * 0.6**2 / 8) < 3e-4


def test_a_flight_that_only_falls_has_no_apex(hops) -> None:  # type: ignore[no-untyped-def]
    times, states, bounces, _ = hops
    late = times > 0.25  # past the first top
    for points, when in (
        true_apexes(times[late], states[late], bounces),
        measured_apexes(times[late], states[late, :3], bounces),
    ):
        assert np.isnan(points[0]).all()
        assert np.isnan(when[0])
        assert np.isfinite(points[1:]).all()


def test_a_track_cut_just_after_its_top_has_a_true_apex_but_shows_none(hops) -> None:  # type: ignore[no-untyped-def]
    times, states, bounces, expected = hops
    early = times < 1.26  # the third top is at 1.25 s
    np.testing.assert_allclose(true_apexes(times[early], states[early], bounces)[0][2], expected[2], atol=1e-12)
    assert np.isnan(measured_apexes(times[early], states[early, :3], bounces)[0][2]).all()


def test_a_path_that_never_rises_has_its_highest_sample(hops) -> None:  # type: ignore[no-untyped-def]
    times, *_ = hops
    falling = np.stack((times, times, -times), axis=-1)
    point, when = path_apex(times, falling, 0.5, 0.9)
    first = times[times >= 0.5][0]
    assert when == first
    np.testing.assert_array_equal(point, [first, first, -first])
    assert np.isnan(path_apex(times, falling, 5.0, 6.0)[0]).all()


def test_a_path_that_has_no_sample_between_two_times_has_no_highest_point() -> None:
    point, time = path_apex(np.array([0.0, 1.0]), np.zeros((2, 3)), 0.2, 0.8)
    assert point.shape == (3,)
    assert np.isnan(point).all()
    assert np.isnan(time)


def test_flights_end_with_the_track() -> None:
    times = np.linspace(0.0, 1.0, 11)
    assert flight_bounds(times, np.array([0.4])) == [(0.0, 0.4), (0.4, 1.0)]
    assert flight_bounds(times, np.array([0.2, 0.4, 0.6, 0.8])) == [(0.0, 0.2), (0.2, 0.4), (0.4, 0.6)]


def shot(times: np.ndarray, states: np.ndarray, bounces: np.ndarray, observed: int = 60) -> TaskShot:
    apexes, when = true_apexes(times, states, bounces)
    track = Track(times, states[:, :3], name="hops")
    return TaskShot(track, states[:, :3], observed, len(times), bounces, apexes, when, states)


def test_errors_of_a_shifted_path_are_the_shift(hops) -> None:  # type: ignore[no-untyped-def]
    times, states, bounces, _ = hops
    score = score_path(shot(times, states, bounces), states[:, :3] + [0.003, 0.0, 0.004])
    assert score.track_rmse == pytest.approx(0.005)
    assert score.rest_rmse == pytest.approx(0.005)
    np.testing.assert_allclose(score.apex, 0.005, atol=1e-9)
    assert score.apex_ahead == (False, True, True)  # 60 samples end at 0.49 s


def test_a_path_that_is_late_by_some_time_is_off_by_speed_times_time() -> None:
    times = np.arange(0.0, 0.6, 1 / RATE)
    late = hop(times, 0.0, 0.6)[:, :3] - [0.02, -0.005, 0.0]  # 2 m/s and -0.5 m/s, 10 ms
    points, when = true_apexes(times, hop(times, 0.0, 0.6), np.array([]))
    errors = apex_errors(times, late, np.array([]), points, when)
    assert errors[0] == pytest.approx(0.01 * np.hypot(2.0, 0.5), rel=1e-6)


def test_methods_that_predict_the_rest_only_are_judged_by_the_rest_only(hops) -> None:  # type: ignore[no-untyped-def]
    times, states, bounces, _ = hops
    path = states[:, :3] + [0.0, 0.002, 0.0]
    path[:60] = np.nan
    score = score_path(shot(times, states, bounces), path)
    assert np.isnan(score.track_rmse)
    assert score.rest_rmse == pytest.approx(0.002)
    assert score.apex[0] is None  # its top was observed
    np.testing.assert_allclose(score.apex[1:], 0.002, atol=1e-9)


def test_bad_predictions_are_refused(hops) -> None:  # type: ignore[no-untyped-def]
    times, states, bounces, _ = hops
    given = shot(times, states, bounces)
    with pytest.raises(ValueError, match="predicted must have shape"):
        score_path(given, states[:-1, :3])
    broken = states[:, :3].copy()
    broken[-1] = np.nan
    with pytest.raises(ValueError, match="must be finite after the 60 observed samples"):
        score_path(given, broken)


def test_pooled_rmse_weighs_samples() -> None:
    assert pooled_rmse([(1.0, 1), (8.0, 2)]) == pytest.approx(np.sqrt(3.0))
