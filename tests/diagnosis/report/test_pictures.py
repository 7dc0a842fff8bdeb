"""What the pictures of a diagnosis show: means, errors and axes against numbers from another route."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from ballfg.diagnosis.report import pictures
from ballfg.diagnosis.report.binned import binned, in_flight, motion_axes, slip_speed, turned
from ballfg.diagnosis.report.predictions import ShotErrors, error_map, shot_picture
from ballfg.diagnosis.report.wording import change, fixed, joined, listed, number, plus_minus, probability
from ballfg.diagnosis.result import Errors, PredictedPath, Value
from tests.diagnosis.made_diagnosis import WIND, errors, found, residuals, rounds


def test_axes_of_a_motion() -> None:
    velocity = np.array([[3.0, 0.0, 4.0], [0.0, 2.0, 0.0], [0.0, 0.0, -5.0], [0.0, 0.0, 0.0]])
    along, left, up = np.moveaxis(motion_axes(velocity), 1, 0)
    assert_allclose(along[:2], [[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]])
    assert_allclose(left[:2], [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert_allclose(up[:2], [[-0.8, 0.0, 0.6], [0.0, 0.0, 1.0]])
    for axes in motion_axes(velocity):  # right-handed also for a ball that falls straight down or rests
        assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(axes) == pytest.approx(1.0)


def test_deviations_in_turned_axes(generator: np.random.Generator) -> None:
    axes = Rotation.random(5, random_state=1).as_matrix()
    roots = generator.normal(size=(5, 3, 3))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    vectors = generator.normal(size=(5, 3))
    components, sigmas = turned(vectors, covariances, axes)
    for i in range(5):
        assert_allclose(components[i], axes[i] @ vectors[i])
        assert_allclose(sigmas[i] ** 2, np.diag(axes[i] @ covariances[i] @ axes[i].T))


def test_slip_of_a_rolling_ball_is_zero() -> None:
    radius, velocity = 0.02, np.array([1.2, -0.7, -3.0])
    rolling = np.cross([0.0, 0.0, 1.0 / radius], velocity)
    states = np.array([[0.0] * 3 + [*velocity, *rolling], [0.0] * 3 + [*velocity, 0.0, 0.0, 50.0]])
    assert_allclose(slip_speed(states, radius), [0.0, np.hypot(1.2, 0.7)], atol=1e-15)


def test_bins_of_equal_numbers(generator: np.random.Generator) -> None:
    """One value a stretch and equal weights: plain means and their standard errors."""
    x = np.arange(120.0)
    y = generator.normal(size=120)
    bins = binned(x, y, np.full(120, 0.3), np.arange(120))
    parts = y.reshape(12, 10)
    assert_allclose(bins.means, parts.mean(axis=1))
    assert_allclose(bins.errors, parts.std(axis=1, ddof=1) / np.sqrt(10))
    assert_allclose(bins.centres, x.reshape(12, 10).mean(axis=1))


def test_bins_weigh_by_precision(generator: np.random.Generator) -> None:
    y, sigma = generator.normal(size=12), generator.uniform(0.1, 2.0, 12)
    bins = binned(np.zeros(12), y, sigma, np.arange(12))
    assert_allclose(bins.means, [np.average(y, weights=sigma**-2)])


def test_rows_of_one_stretch_count_as_one(generator: np.random.Generator) -> None:
    """Each value thrice in the same stretch tells no more than once."""
    y = generator.normal(size=30)
    once = binned(np.zeros(30), y, np.ones(30), np.arange(30))
    thrice = binned(np.zeros(90), np.repeat(y, 3), np.ones(90), np.repeat(np.arange(30), 3))
    assert_allclose(thrice.errors, once.errors)


def test_few_or_no_stretches() -> None:
    assert len(binned(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64)).means) == 0
    assert len(binned(np.zeros(8), np.zeros(8), np.ones(8), np.repeat([0, 1], 4)).means) == 0


def test_flight_picture_shows_the_wind() -> None:
    """The means of the panels are those of the accelerations, before and after on the same axes."""
    diagnosis = found()
    series = {"before": diagnosis.residuals_before, "after": diagnosis.residuals_after}
    axes = pictures.flight_in_time(series).axes
    values, _ = in_flight(diagnosis.residuals_before.flight)
    means = {i: shown(axes[i]) for i in range(6)}
    assert np.average(means[0]) == pytest.approx(values[:, 0].mean(), rel=0.02)
    assert means[0].min() > 0.15
    assert abs(means[1]).max() < 0.15
    assert axes[0].get_ylim() == axes[5].get_ylim()
    assert [axes[i].get_title() for i in (0, 1)] == ["before", "after"]
    assert axes[0].get_ylabel() == "along the flight, m/s²"
    assert axes[4].get_xlabel() == "time since launch or hit, s"


def shown(axes: Axes) -> np.ndarray:
    """Means that the error bars of a panel stand on."""
    (bars,) = (c for c in axes.containers if isinstance(c, ErrorbarContainer))
    return np.asarray(bars.lines[0].get_ydata())


def test_contact_picture_has_the_same_axes_before_and_after() -> None:
    series = {"before": residuals(WIND, 3), "after": residuals(0.0, 4)}
    axes = np.array(pictures.contacts(series, 0.02).axes).reshape(3, 4)
    assert axes[0, 0].get_xlim() == axes[2, 1].get_xlim()
    assert axes[0, 2].get_xlim() == axes[1, 3].get_xlim()
    assert len({a.get_ylim() for a in axes.flat}) == 1
    assert [a.get_xlabel() for a in axes[2]] == ["incoming normal speed, m/s"] * 2 + ["incoming slip, m/s"] * 2
    dots = axes[2, 0].lines[0]
    assert_allclose(dots.get_ydata(), series["before"].contact.velocity[:, 2])
    assert_allclose(dots.get_xdata(), -series["before"].contact.incoming[:, 5])


def test_outliers_do_not_hide_a_pattern() -> None:
    left = residuals(0.0, 4)
    left.measurement.position[::50, 0] = 30.0
    axes = pictures.measurements({"the fitted model": left}).axes
    assert abs(shown(axes[0])).max() < pictures.LARGEST_WHITENED
    assert axes[10].get_ylabel() == "residual z, sigma"
    assert axes[11].get_xlabel() == "x, m"


def test_histogram_of_whitened_residuals() -> None:
    left = residuals(0.0, 4)
    (axes,) = pictures.histogram({"the fitted model": left}).axes
    for i, line in enumerate(axes.lines[:3]):
        whitened = left.measurement.position[:, i] / 0.003
        density = np.nan_to_num(line.get_ydata())
        assert density.sum() * 0.25 == pytest.approx((abs(whitened) <= 6).mean())
        middle = abs(np.asarray(line.get_xdata())) < 1.0
        assert density[middle].sum() * 0.25 == pytest.approx((abs(whitened) < 1).mean(), rel=1e-9)


def test_a_shot_is_seen_along_its_own_direction() -> None:
    """From (1, 2) towards (3, 4) on the table, 1 m up on each 5 m; predicted 0.1 m too far to the left."""
    along = np.arange(6.0)[:, None]
    points = np.array([1.0, 2.0, 0.5]) + along * [0.6, 0.8, 0.2]
    left = np.array([-0.08, 0.06, 0.0])
    path = PredictedPath("a", points[:3], 0.1 * np.arange(1.0, 4.0), points[3:] + left, points[3:])
    figure = shot_picture(ShotErrors(path, path), changed=False)
    side, top, error = figure.axes
    for axes, up in ((side, [0.5, 0.7, 0.9, 1.1, 1.3, 1.5]), (top, np.zeros(6))):
        seen, later, predicted = axes.lines
        assert_allclose(seen.get_xydata(), np.column_stack((along[:3], up[:3])), atol=1e-12)
        assert_allclose(later.get_xydata(), np.column_stack((along[3:], up[3:])), atol=1e-12)
        off = 0.1 if axes is top else 0.0
        assert_allclose(predicted.get_xydata(), np.column_stack((along[3:], np.add(up[3:], off))), atol=1e-12)
    assert_allclose(error.lines[0].get_xydata(), [[0.1, 100.0], [0.2, 100.0], [0.3, 100.0]], atol=1e-9)


def test_errors_are_shown_along_the_recording() -> None:
    """A ball that wears: each track is predicted 2 mm worse than the one before it; the correction takes half away."""

    def worse(rate_mm: float) -> Errors:
        measured = np.zeros((6, 3))
        off = [1e-3 * rate_mm * (k + 1) * np.array([0.6, 0.0, 0.8]) for k in range(5)]
        paths = [
            PredictedPath(f"{k}", measured[:2], 0.1 * np.arange(1, 7), measured + shift, measured)
            for k, shift in enumerate(off)
        ]
        return Errors(9.0, 9.0, 1.0, 0.0, np.full(5, 9.0), paths=tuple(paths))

    panel = error_map(worse(2.0), worse(1.0), True).axes[-1]
    for line, rate in zip(panel.get_lines(), (2.0, 1.0), strict=True):
        assert_allclose(line.get_xdata(), np.arange(1, 6))
        assert_allclose(line.get_ydata(), rate * np.arange(1, 6))
    assert "order" in panel.get_xlabel()


def test_errors_by_track_leaves_out_what_could_not_be_judged() -> None:
    before, after = errors(20.0, 1), errors(10.0, 2)
    after.by_track[0] = np.nan
    before.by_track[1], after.by_track[1] = 5.0, 6.0
    axes = pictures.errors_by_track(before, after).axes[0]
    fell = sum(a < b for b, a in zip(before.by_track[1:], after.by_track[1:], strict=True))
    assert axes.get_title() == f"smaller on {fell} of 24 tracks"
    assert len(axes.lines) == 25
    worse = axes.lines[0]
    assert (list(worse.get_ydata()), worse.get_color()) == ([5.0, 6.0], pictures.BEFORE)


def test_no_track_could_be_judged_before_and_after() -> None:
    none = Errors(10.0, np.nan, 1.0, 3.0, np.full(3, np.nan))
    assert pictures.errors_by_track(none, none).axes[0].get_title() == "smaller on 0 of 0 tracks"


def test_rounds_name_the_added_one_and_leave_the_invisible_out() -> None:
    axes = pictures.ranking(rounds()).axes[0]
    words = [text.get_text() for text in axes.texts]
    assert words == ["magnus_saturation", "frame_tilt", "time_scale", "drag_speed", "gust_region, alike", "wind, added"]
    heights = np.log([text.get_position()[1] for text in axes.texts])
    assert (np.diff(heights) > 0.3).all()
    lines = [line for line in axes.lines if line.get_marker() == "o"]
    assert len(lines) == sum(c.outcome.value != "cannot be seen in these data" for c in rounds()[0])


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (Value(0.20312, 0.0123, "m/s"), "0.203 ± 0.012 m/s"),
        (Value(-598.31, 21.0, "rad/s"), "-598 ± 21 rad/s"),
        (Value(0.0028412, 0.00003, "1"), "0.002841 ± 0.000030"),
        (Value(3.21e-9, 4.4e-10, "s"), "3.21e-09 ± 4.4e-10 s"),
        (Value(0.5, float("nan"), "1"), "0.5"),
        (Value(9.81, 0.0, "m/s^2"), "9.81 m/s^2"),
    ],
)
def test_values_in_words(value: Value, words: str) -> None:
    assert plus_minus(value) == words


def test_other_words() -> None:
    assert [probability(p) for p in (1.0, 0.0412, 3.2e-12, 4e-131, 0.0, 5e-4)] == [
        *("1", "0.041", "3e-12", "less than 1e-99", "less than 1e-99", "5e-4")
    ]
    assert (probability(float("nan")), number(float("nan")), fixed(float("nan"), 1)) == ("–", "–", "–")
    assert [joined(names) for names in ((), ("a",), ("a", "b"), ("a", "b", "c"))] == ["", "a", "a and b", "a, b and c"]
    assert (change(20.0, 13.2), change(0.0, 1.0), change(1.0, float("nan"))) == ("-34 %", "", "")
    assert listed({"x": Value(1.0, 0.1, "m"), "y": Value(2.0, 0.2, "1")}) == "x 1.00 ± 0.10 m, y 2.00 ± 0.20"


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(11)
