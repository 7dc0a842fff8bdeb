"""What the report of a calibration says in sentences: whether it helped, what the tracks do not tell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ballfg.dynamics import nominal_model
from ballfg.learning.calibration.problem import Problem, Step, pose
from ballfg.learning.calibration.report import Comparison, outcome, report, table, verdict
from ballfg.learning.calibration.run import status_of
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import Summary, denser, gain_of
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


def compared(change: float, spread: float = 0.01) -> Comparison:
    """Errors of 20 mm that change by a share, give or take."""
    made = [Summary(tracks=3, rmse_median=e, rmse_pooled=2 * e, coverage_90=0.88, prediction_nis=3.2, nis=2.9) for e in
            (0.020, 0.010, 0.011, 0.012)]  # fmt: skip
    after = 0.02 * (1.0 + change) * np.exp([-spread, 0.0, spread])
    return Comparison(*made, 2, np.stack((np.full(3, 0.02), after), axis=1), 0)


def test_errors_that_hardly_fall_do_not_change_by_minus_nothing(problem: Problem) -> None:
    said = verdict(problem, step(problem), compared(-0.003, 0.001))
    assert "errors change by +0 % (" in said
    assert "-0 " not in said


@pytest.mark.parametrize(
    ("change", "spread", "word"),
    [(-0.5, 0.01, "better"), (0.5, 0.01, "worse"), (-0.5, 1.0, "no different"), (-0.01, 0.0, "no different")],
)
def test_whether_it_predicts_better_is_said_first(problem: Problem, change: float, spread: float, word: str) -> None:
    comparison = compared(change, spread)
    assert outcome(comparison) == word
    said = verdict(problem, step(problem), comparison)
    assert said.startswith(f"The calibrated model predicts {word}: errors change by {100 * change:+.0f} % (")
    assert "Median RMSE 20.0 mm before, 10.0 mm after; it fell on 2 of 3 tracks. With the population as each" in said
    judged = report(problem, step(problem), comparison, None)["judged"]
    assert (judged["outcome"], judged["worse"]) == (word, word == "worse")
    assert outcome(NONE) == "not known"


def test_status_of_a_model_that_the_fitted_tracks_chose_is_1_only_if_it_is_worse() -> None:
    words = ("better", "no different", "not known", "worse")
    assert [status_of(word, proven=False) for word in words] == [0, 1, 1, 1]
    assert [status_of(word, proven=True) for word in words] == [0, 0, 0, 1]


def test_interval_is_students() -> None:
    """Against scipy's interval of a mean."""
    rng = np.random.default_rng(1)
    before = np.exp(rng.standard_normal(12))
    change = rng.normal(-0.1, 0.2, 12)
    gain = gain_of(before, before * np.exp(change))
    assert gain is not None
    expected = stats.ttest_1samp(change, 0.0).confidence_interval(0.95)
    np.testing.assert_allclose(np.log1p([gain.low, gain.high]), expected, rtol=1e-9)


def test_the_density_decides_where_errors_do_not() -> None:
    rng = np.random.default_rng(2)
    before = np.exp(rng.standard_normal(12))
    gain = gain_of(before, before * np.exp(rng.normal(0.0, 0.2, 12)))
    assert gain is not None
    assert gain.word == "no different"
    scores, rise = rng.normal(2.0, 1.0, 12), rng.normal(0.3, 0.1, 12)
    mean, low = denser(scores, scores + rise)
    assert low == pytest.approx(stats.ttest_1samp(rise, 0.0).confidence_interval(0.95).low)
    for density, word in (((mean, low), "better"), ((0.3, 0.05), "no different"), ((0.05, 0.04), "no different")):
        assert replace(gain, density=density).word == word
    assert f"{np.exp(mean):.2f} times as probable" in str(replace(gain, density=(mean, low)))
    unsure = str(replace(gain, density=(0.3, 0.05)))  # its lower end is what decides
    assert unsure.endswith("1.35 times as probable (surely 1.05 times)")
    worse = gain_of(before, 1.5 * before * np.exp(rng.normal(0.0, 0.01, 12)))
    assert worse is not None
    assert replace(worse, density=(mean, low)).word == "worse"


def test_what_is_not_known_is_said(problem: Problem) -> None:
    chosen = problem.chosen
    last = step(problem, 0.7, mean_0=float(chosen.high[0]), sigma_1=0.99 * float(chosen.sigma[1]))
    assert verdict(problem, last, NONE) == (
        f"Too few tracks could be judged: whether the prediction is better is not known. {chosen.names[0]} lies at its "
        "bound: another effect may be missing, or a unit is wrong. The mean still moved by 0.7 standard errors in "
        f"iteration 4: continue with a larger max_iterations. The tracks say little of {chosen.names[1]}: its value is "
        "the model's."
    )
    start, sigma = float(chosen.start[1]), 0.99 * float(chosen.sigma[1])
    moved = verdict(problem, step(problem, mean_1=start + 0.2 * sigma, sigma_1=sigma), NONE)
    number = f"{start + 0.2 * sigma:.4g}"
    assert f"little of {chosen.names[1]}: {number} is hardly surer than the model's {start:.4g}." in moved


def test_errors_before_and_after_stand_side_by_side(problem: Problem) -> None:
    rows = table(problem, step(problem), compared(-0.5)).splitlines()
    cells = {row.split("  ")[0].strip(): row.split()[-4:] for row in rows if row.strip()}
    for name, numbers in {
        "RMSE, median": ["20", "10", "11", "12"],
        "RMSE, pooled": ["40", "20", "22", "24"],
        "90 % intervals hold": ["88", "88", "88", "88"],
    }.items():
        (found,) = (own for label, own in cells.items() if label.startswith(name))
        assert [float(cell) for cell in found] == [float(number) for number in numbers], name


def test_means_that_predict_best_are_told(problem: Problem) -> None:
    moved = step(problem).model_copy(update={"predicting": 0.0514})
    said, words = (verdict(problem, one, compared(-0.5)) for one in (moved, step(problem)))
    assert "The means are those that predict best, by +0.051 in the log score of fitted tracks that were left" in said
    assert "predict best" not in words
    assert report(problem, moved, compared(-0.5), None)["predicting_gain"] == 0.0514
