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
