"""What the report of a calibration says in sentences: whether it helped, what the tracks do not tell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ballfg.dynamics import nominal_model
from ballfg.learning.calibration.calibrate import Problem, Step, pose
from ballfg.learning.calibration.report import Comparison, is_worse, report, table, verdict
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import Summary
from ballfg.tracks import read_dataset

NONE = Comparison(None, None, None, None, 0, np.zeros((0, 2)), 3)


@pytest.fixture(scope="module")
def problem(few_tracks: Path) -> Problem:
    return pose(read_dataset(few_tracks), nominal_model(), CalibrationConfig())


def step(problem: Problem, moved: float = 0.0, **changed: float) -> Step:
    """The last one: every coefficient where it was, its prior halved, but for `mean_0` and `sigma_1`, say."""
    values = {"mean": problem.chosen.start.copy(), "sigma": 0.5 * problem.chosen.sigma}
    for name, value in changed.items():
        what, _, k = name.partition("_")
        values[what][int(k)] = value
    numbers = {name: tuple(column.tolist()) for name, column in values.items()}
    return Step(number=4, moved=moved, spread=numbers["sigma"], next_track=numbers["sigma"], **numbers)


def compared(before: float, after: float, spread: float, noise: float) -> Comparison:
    made = [Summary(tracks=3, rmse_median=e, rmse_pooled=2 * e, coverage_90=0.88, prediction_nis=3.2, nis=2.9) for e in
            (before, after, spread, noise)]  # fmt: skip
    return Comparison(*made, 2, np.zeros((3, 2)), 0)


@pytest.mark.parametrize(("after", "word"), [(0.010, "better"), (0.030, "NOT better")])
def test_whether_it_predicts_better_is_said_with_numbers(problem: Problem, after: float, word: str) -> None:
    assert verdict(problem, step(problem), compared(0.020, after, 0.011, 0.012)) == (
        f"The calibrated model predicts {word}: median RMSE 20.0 mm before, {1e3 * after:.1f} mm after, on 3 tracks "
        "that were not fitted; it fell on 2 of them. With the population as each track's prior it has 11.0 mm. With "
        "the noise that the fitted tracks show, 12.0 mm, and 90 % intervals hold 88 %."
    )


@pytest.mark.parametrize(("noise", "worse"), [(0.019, False), (0.021, True)])
def test_a_file_that_predicts_worse_is_not_silent(problem: Problem, noise: float, worse: bool) -> None:
    """What counts is the model that is written, with its population and noise."""
    comparison = compared(0.020, 0.010, 0.011, noise)
    assert is_worse(comparison) is worse
    assert ("predicts WORSE than the one before" in verdict(problem, step(problem), comparison)) is worse
    assert report(problem, step(problem), comparison, None)["judged"]["worse"] is worse
    assert not is_worse(NONE)


def test_what_is_not_known_is_said(problem: Problem) -> None:
    chosen = problem.chosen
    last = step(problem, 0.7, mean_0=float(chosen.high[0]), sigma_1=0.99 * float(chosen.sigma[1]))
    assert verdict(problem, last, NONE) == (
        "The mean still moved by 0.7 standard errors in iteration 4: continue with a larger max_iterations. No track "
        f"could be judged: whether the prediction is better is not known. {chosen.names[0]} lies at its bound: another "
        f"effect may be missing, or a unit is wrong. The tracks say little of {chosen.names[1]}: its value is the "
        "model's."
    )


def test_errors_before_and_after_stand_side_by_side(problem: Problem) -> None:
    rows = table(problem, step(problem), compared(0.020, 0.010, 0.011, 0.012)).splitlines()
    cells = {row.split("  ")[0].strip(): row.split()[-4:] for row in rows if row.strip()}
    for name, numbers in {
        "RMSE, median": ["20", "10", "11", "12"],
        "RMSE, pooled": ["40", "20", "22", "24"],
        "90 % intervals hold": ["88", "88", "88", "88"],
    }.items():
        (found,) = (own for label, own in cells.items() if label.startswith(name))
        assert [float(cell) for cell in found] == [float(number) for number in numbers], name
