"""What the pictures of the benchmarks show: the numbers of the rows, each where it belongs."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

from ballfg.benchmarks.diagnosis.pictures import ALL, repair_picture
from ballfg.benchmarks.estimators.measured import Measured
from ballfg.benchmarks.estimators.pictures import calibration_picture, observations_picture
from ballfg.benchmarks.results import Row


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were closed after they had been written."""
    figures: list[Figure] = []
    close = plt.close

    def kept(figure: Figure) -> None:
        figures.append(figure)
        close(figure)

    monkeypatch.setattr(plt, "close", kept)
    return figures


def points(figure: Figure, label: str) -> list[tuple[float, float]]:
    (line,) = [line for line in figure.axes[0].get_lines() if line.get_label() == label]
    return [(float(x), float(y)) for x, y in np.asarray(line.get_xydata())]


def test_a_calibrated_method_lies_on_the_diagonal(closed: list[Figure], tmp_path: Path) -> None:
    levels = (0.1, 0.5, 0.9)
    rows = [Row("hall", "smoother", f"coverage@{level}", "1", level, None, None, 9) for level in levels]
    path = calibration_picture(rows, Measured("hall", {"smoother": []}, [], 0), tmp_path / "a.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    (figure,) = closed
    assert points(figure, "perfect") == [(0.0, 0.0), (1.0, 1.0)]
    (drawn,) = [line for line in figure.axes[0].get_lines() if line.get_label() != "perfect"]
    np.testing.assert_allclose(drawn.get_xydata(), np.stack((levels, levels), axis=-1))


def test_each_effect_has_a_line_of_its_own_before_and_after(closed: list[Figure], tmp_path: Path) -> None:
    ratios = {"wind": (1.8, 1.02), "scale": (3.0, 0.99)}
    rows = [
        Row("repair", method, name, "1", value, 0.9 * value, 1.1 * value, 1)
        for name, pair in ratios.items()
        for method, value in zip(("before / true", "after / true"), pair, strict=True)
    ]
    others = [
        Row("repair", "before / true", ALL, "1", 2.0, 1.0, 3.0, 2),
        Row("naming", "before / true", "drag", "1", 2.0, 1.0, 3.0, 2),
    ]
    repair_picture([*others, *rows], tmp_path / "a.png")
    (figure,) = closed
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["wind", "scale"]
    assert points(figure, "before / true") == [(1.8, 0.0), (3.0, 1.0)]
    assert points(figure, "after / true") == [(1.02, 0.0), (0.99, 1.0)]


def test_errors_by_observations_stand_on_an_axis_of_plain_numbers(closed: list[Figure], tmp_path: Path) -> None:
    means = {"ekf": (2.0, 0.5, 0.04), "smoother": (1.0, 0.3, 0.02)}
    rows = [
        Row("paper", method, f"velocity_{what}_{when}@{n}", "m/s", share * mean, None, None, 9)
        for method, values in means.items()
        for n, mean in zip((2, 10, 50), values, strict=True)
        for what, share in (("mean", 1.0), ("sd", 0.3))
        for when in ("newest", "whole")
    ]
    observations_picture(rows, "paper", "a title", tmp_path / "a.png")
    (figure,) = closed
    figure.draw_without_rendering()
    for axes in figure.axes:
        for line, values in zip(axes.get_lines(), means.values(), strict=True):
            np.testing.assert_allclose(line.get_xydata(), np.stack(((2, 10, 50), values), axis=-1))
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert {"0.05", "0.1", "1"} <= set(labels), labels
    assert not any("10^" in label for label in labels)
