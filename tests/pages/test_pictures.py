"""Pictures for papers: their lines are the numbers, their axes have units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from ballfg.pages.given import recognise
from ballfg.pages.pictures import by_axis, views
from ballfg.pages.shown import Shown, collect
from tests.pages.made import SPREAD, Made

LEVEL_90 = 1.6448536


@pytest.fixture(scope="module")
def shown(made: Made) -> Shown:
    return collect(recognise([made.dataset, made.states, made.predictions]))


def lines(figure: Figure, panel: int) -> dict[str, np.ndarray]:
    return {str(line.get_label()): np.column_stack(line.get_data()) for line in figure.axes[panel].lines}


def test_views_from_the_side_and_above(shown: Shown) -> None:
    shot = shown.shots[0]
    figure = views(shot, shown.table)
    assert [axes.get_ylabel() for axes in figure.axes] == ["z, m", "y, m"]
    assert figure.axes[1].get_xlabel() == "x, m"
    for panel, up in ((0, 2), (1, 1)):
        np.testing.assert_array_equal(lines(figure, panel)["estimate"], shot.states[:, [0, up]])
        np.testing.assert_array_equal(lines(figure, panel)["measured"], shot.positions[:, [0, up]])
    np.testing.assert_array_equal(lines(figure, 0)["table"], [[0.0, 0.76], [2.74, 0.76]])


def test_a_band_is_ninety_percent_wide_across_the_path(shown: Shown) -> None:
    shot = shown.shots[0]
    bands = [c for c in views(shot).axes[1].collections if isinstance(c, PolyCollection)]
    corners = np.array([path.vertices[:4] for path in bands[1].get_paths()])
    width = np.linalg.norm(corners[:, 0] - corners[:, 3], axis=1)
    np.testing.assert_allclose(width, 2 * LEVEL_90 * SPREAD, rtol=1e-6)


def test_nothing_is_drawn_over_a_gap_or_where_the_ball_is_held(made: Made, shown: Shown) -> None:
    """Of the prediction 0.35 .. 0.45 s is missing; the estimate leaves the first ten samples as measured."""
    shot, n = shown.shots[0], len(shown.shots[0].states)
    kept = (shot.predicted_times <= 0.345) | (shot.predicted_times > 0.455)
    names = ("predicted_times", "predicted", "predicted_sigmas")
    gapped = replace(shot, **{name: getattr(shot, name)[kept] for name in names})
    gapped = replace(gapped, labels=np.array(["held"] * 10 + ["flight"] * (n - 10)))
    for figure, bands in ((views(gapped), True), (by_axis(gapped), False)):
        drawn = lines(figure, 0)
        assert np.isnan(drawn["estimate"][:10, 1]).all()
        assert np.isfinite(drawn["estimate"][10:]).all()
        (row,) = np.flatnonzero(np.isnan(drawn["prediction"]).all(axis=1))
        np.testing.assert_array_equal(np.delete(drawn["prediction"], row, 0)[:, 1], gapped.predicted[:, 2 * bands])
        assert row == int((gapped.predicted_times < 0.4).sum())
    steps = [len(c.get_paths()) for c in views(gapped).axes[0].collections if isinstance(c, PolyCollection)]
    assert steps == [n - 10 - 1, kept.sum() - 2]


def test_a_slow_recording_has_lines(shown: Shown) -> None:
    shot = replace(shown.shots[0], times=20.0 * shown.shots[0].times, predicted_times=np.zeros(0))
    shot = replace(
        shot, state_times=20.0 * shot.state_times, predicted=np.zeros((0, 3)), predicted_sigmas=np.zeros((0, 3))
    )
    assert np.isfinite(lines(by_axis(shot), 0)["estimate"]).all()  # 5 Hz


def test_a_flight_along_y_is_drawn_over_y(shown: Shown) -> None:
    shot = shown.shots[0]
    turned = replace(shot, **{name: getattr(shot, name)[:, [1, 0, 2]] for name in ("positions", "predicted")})
    figure = views(replace(turned, states=np.zeros((0, 9)), state_times=np.zeros(0)))
    assert [axes.get_ylabel() for axes in figure.axes] == ["z, m", "x, m"]
    assert figure.axes[1].get_xlabel() == "y, m"


def test_each_axis_by_time(shown: Shown) -> None:
    shot = shown.shots[0]
    figure = by_axis(shot)
    assert [axes.get_ylabel() for axes in figure.axes] == ["x, m", "y, m", "z, m"]
    for axis in range(3):
        drawn = lines(figure, axis)["prediction"]
        np.testing.assert_array_equal(drawn, np.column_stack((shot.predicted_times, shot.predicted[:, axis])))
        low, high = figure.axes[axis].collections[1].get_datalim(figure.axes[axis].transData).intervaly
        assert low == pytest.approx((shot.predicted[:, axis] - LEVEL_90 * SPREAD).min())
        assert high == pytest.approx((shot.predicted[:, axis] + LEVEL_90 * SPREAD).max())
