"""Tables, pictures and reprs of what an estimate gives."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

import ballfg as bf
from ballfg.estimation.segmentation.result import Contact

PANDAS = importlib.util.find_spec("pandas") is not None


@pytest.mark.skipif(not PANDAS, reason="pandas is not installed")
def test_tables(estimate: bf.Estimate) -> None:
    frame = estimate.to_frame()
    assert list(frame.columns[:4]) == ["t", "x", "y", "z"]
    np.testing.assert_array_equal(frame["sigma_vx"], estimate.sigmas[:, 3])
    np.testing.assert_array_equal(estimate.predict(0.1).to_frame()["sigma_z"], estimate.predict(0.1).sigmas[:, 2])


@pytest.mark.skipif(PANDAS, reason="pandas is installed")
def test_tables_need_pandas(estimate: bf.Estimate) -> None:
    for shown in (estimate, estimate.predict(0.1)):
        with pytest.raises(ImportError, match="Install it: pip install pandas"):
            shown.to_frame()


def test_the_picture_has_units_and_the_numbers(estimate: bf.Estimate) -> None:
    figure = estimate.plot()
    assert isinstance(figure, Figure)
    assert [axes.get_ylabel() for axes in figure.axes] == ["position, m", "velocity, m/s", "spin, rad/s"]
    assert figure.axes[-1].get_xlabel() == "time, s"
    for k, axes in enumerate(figure.axes):
        for axis, line in enumerate(axes.lines[:3]):
            np.testing.assert_array_equal(line.get_ydata(), estimate.states[:, 3 * k + axis])
    turned = replace(estimate, hits=np.array([1]), contacts=(Contact(3, 0.5 * estimate.times[[3, 4]].sum(), 0.0),))
    for axes in turned.plot().axes:
        contact, hit = axes.lines[3:]
        assert (contact.get_linestyle(), set(contact.get_xdata())) == ("--", {turned.contacts[0].time})
        assert (hit.get_linestyle(), set(hit.get_xdata())) == (":", {estimate.times[[1, 2]].mean()})


def test_reprs_are_short_and_say_what_a_thing_holds(shots: bf.Dataset, track: bf.Track, estimate: bf.Estimate) -> None:
    smoother = bf.Smoother(shots.ball, shots.table)
    speeds = bf.RadarSpeed([0, 3], [5.0, 5.0], 0.1)
    crossing = estimate.predict(1.0).next_contact
    expected = {
        "Estimate": (estimate, ("'000'", f"{len(track)} states over 0.3", "ok", "up to")),
        "Smoother": (smoother, ("AnalyticModel", "table at 0.76 m", "noise 1.5 / 1.5 / 1.5 mm")),
        "Online": (bf.Online(shots.ball, shots.table), ("table at 0.76 m",)),
        "Track": (track.observed(speeds), ("'000'", f"{len(track)} samples", "RadarSpeed(2 of 2 samples)")),
        "Dataset": (shots, ("'simulated table-tennis'", "3 tracks", "my_shots")),
        "BallState": (estimate.last, ("t = ", "position (", ") m +- (", "velocity", "spin", "rad/s")),
        "Forecast": (estimate.predict(0.2), ("20 times to t = ", "+-")),
        "Crossing": (crossing, ("t = ", " ms, at (", ") mm")),
        "RadarSpeed": (speeds, ("2 of 2 samples",)),
    }
    for name, (shown, parts) in expected.items():
        text = repr(shown)
        assert text.startswith(f"{name}(")
        assert text.count("\n") <= 2
        assert "0x" not in text
        assert "array(" not in text
        for part in parts:
            assert part in text, text
