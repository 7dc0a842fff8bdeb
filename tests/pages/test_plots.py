"""Results draw themselves: predictions with their bands, a diagnosis with its errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import ballfg as bf
from ballfg.diagnosis import Diagnosis
from ballfg.pages.pictures import by_axis
from ballfg.pages.shot import ShownShot
from tests.diagnosis.made_diagnosis import found, silent
from tests.pages.made import Fall, Made, make

LEVEL_90 = 1.6448536


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("small"), {"a": Fall()})


@pytest.fixture(scope="module")
def estimate(small: Made) -> bf.Estimate:
    return bf.estimate(str(small.dataset))["a"]


def check(figure: Figure, label: str, times: np.ndarray, places: np.ndarray, sigmas: np.ndarray) -> None:
    """The line of a label and the last band of each axis are these numbers."""
    assert [axes.get_ylabel() for axes in figure.axes] == ["x, m", "y, m", "z, m"]
    for axis, panel in enumerate(figure.axes):
        (line,) = [one for one in panel.lines if one.get_label() == label]
        np.testing.assert_array_equal(np.column_stack(line.get_data()), np.column_stack((times, places[:, axis])))
        edges = panel.collections[-1].get_datalim(panel.transData).intervaly
        width = LEVEL_90 * sigmas[:, axis]
        assert edges == pytest.approx([(places[:, axis] - width).min(), (places[:, axis] + width).max()])


def test_a_path_ahead(estimate: bf.Estimate) -> None:
    ahead = estimate.predict(0.3)
    check(ahead.plot(), "prediction", ahead.times, ahead.positions, ahead.sigmas)


def test_one_of_several_balls(estimate: bf.Estimate) -> None:
    from ballfg.prediction import Propagator
    from ballfg.prediction.forecast import carried_by

    propagator, belief = carried_by(estimate.last)
    assert isinstance(propagator, Propagator)
    time, covariance = np.tile(belief.time, 2), np.tile(belief.covariance, (2, 1, 1))
    both = replace(belief, time=time, mean=np.concatenate((belief.mean, belief.mean + 0.1)), covariance=covariance)
    several = propagator.rollout(both, estimate.last.time + np.array([[0.1, 0.2, 0.3]] * 2))
    for ball, figure in ((0, several.plot()), (1, several.plot(1))):
        sigmas = np.sqrt(np.diagonal(several.covariances[ball], axis1=1, axis2=2))
        check(figure, "prediction", several.times[ball], several.states[ball, :, :3], sigmas)


def test_a_prediction_against_what_was_measured(small: Made) -> None:
    predicted = bf.predict(str(small.dataset), observe=0.3)["a"]
    figure = predicted.plot()
    check(figure, "prediction", predicted.times, predicted.positions, predicted.sigmas)
    (measured,) = [line for line in figure.axes[2].lines if line.get_label() == "measured"]
    np.testing.assert_array_equal(measured.get_ydata(), predicted.measured[:, 2])
    dashed = [line for line in figure.axes[0].lines if line.get_linestyle() == "--"]
    assert [line.get_xdata()[0] for line in dashed] == [contact.time for contact in predicted.estimate.contacts]
    assert len(dashed) == 1


@pytest.mark.parametrize(("diagnosis", "label"), [(found(), "prediction error, mm"), (silent(), "density")])
def test_a_diagnosis(diagnosis: Diagnosis, label: str) -> None:
    assert diagnosis.plot().axes[0].get_ylabel() == label


def test_a_name_with_signs_of_mathematics_is_drawn(estimate: bf.Estimate, tmp_path: Path) -> None:
    named = replace(estimate, name="a$_^$0")
    for figure in (named.plot(), by_axis(ShownShot(named.name, named.times, named.states[:, :3]))):
        figure.savefig(tmp_path / "named.png")
        assert r"track a\$_^\$0: " in figure.axes[0].get_title()


def test_states_are_not_drawn_over_a_gap_nor_a_motion_that_nobody_estimated(estimate: bf.Estimate) -> None:
    """The first ten samples are left as measured, as of a held ball; half a second is missing after the twentieth."""
    times, states = estimate.times.copy(), estimate.states.copy()
    states[:10, 3:], times[20:] = 0.0, times[20:] + 0.5
    panels = replace(estimate, times=times, states=states).plot().axes
    for k, panel in enumerate(panels):
        for axis, line in enumerate(panel.lines[:3]):
            at, drawn = line.get_data()
            assert np.isnan(at[20])
            assert np.isnan(drawn[20])
            known = np.delete(drawn, 20)
            assert np.isnan(known[:10]).all() == (k > 0)
            np.testing.assert_array_equal(known[10:], states[10:, 3 * k + axis])
    widths = [one.get_datalim(panels[1].transData).height for one in panels[1].collections]
    assert max(widths) < 10.0
