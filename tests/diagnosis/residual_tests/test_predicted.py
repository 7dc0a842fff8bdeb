"""What is left is noise only if the other half of the tracks errs as that noise expects."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from ballfg.diagnosis import diagnose
from ballfg.diagnosis.generic_test import ALARM, PREDICTED
from ballfg.diagnosis.report.headline import headline
from ballfg.diagnosis.residual_tests.generic import predicted_test
from ballfg.diagnosis.result import Errors, Verdict
from ballfg.diagnosis.search.evaluation import error_of_mean
from ballfg.dynamics import EFFECTS, load_model
from ballfg.simulation import SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import read_dataset


def errors(rmse_mm: float, nis: float, nis_error: float, tracks: int = 8) -> Errors:
    return Errors(rmse_mm, 0.0, nis, 0.0, np.full(tracks, rmse_mm), nis_error=nis_error)


def odd_or_even(folder: Path, rest: int) -> list[dict[str, str]]:
    """Rows of every second track."""
    with (folder / "tracks.csv").open(encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if int(row["trajectory"]) % 2 == rest]


def test_chance_raises_no_alarm():
    """The noise is known from as many tracks as are judged, and errors of a track go together: two are independent."""
    rng, loud = np.random.default_rng(2), 0
    for _ in range(4000):
        known = rng.chisquare(2, 10).mean() / 2.0
        squares = [np.repeat(one / 2.0 / known, 30) for one in rng.chisquare(2, 10)]
        judged = errors(9.0, float(np.mean(squares)), error_of_mean(squares), 10)
        loud += predicted_test(judged, judged, 10).p_value < ALARM
    assert loud < 4000 * 2 * ALARM


@pytest.mark.parametrize(
    ("before", "after", "share"),
    [
        (errors(100.0, 20.0, 2.0), errors(100.0, 20.0, 2.0), 1.0),  # nothing found: all of it is left
        (errors(100.0, 20.0, 2.0), errors(10.0, 2.0, 0.1), 50.0 / 9950.0),
        (errors(50.0, 20.0, 2.0), errors(100.0, 20.0, 2.0), 1.0),  # predictions got worse
    ],
)
def test_the_share_is_that_of_the_squared_error_beyond_the_noise(before, after, share):
    test = predicted_test(before, after, 8)
    assert test.p_value < ALARM
    assert test.share == pytest.approx(share)


def test_without_a_scatter_nothing_is_said():
    for after in (errors(9.0, 2.0, float("nan"), 1), errors(9.0, float("nan"), 0.1), errors(9.0, 0.8, 0.1)):
        assert predicted_test(after, after, 8).p_value == 1.0


def test_balls_thrown_in_turn_are_not_noise(tmp_path):
    """A fan runs at every second shot: the half that is searched sees none of it, and fits well."""
    for name, effects in (("still", ()), ("fan", parse_effects(["wind.x=1"]))):
        write_simulation(tmp_path / name, SimulationConfig(tracks=12, rate=60.0, seed=5, undeclared=effects))
    rows = [row for rest, name in enumerate(("still", "fan")) for row in odd_or_even(tmp_path / name, rest)]
    with (tmp_path / "still" / "tracks.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda row: row["trajectory"]))
    folder = tmp_path / "still"
    model = load_model(folder / "model.yaml")
    diagnosis = diagnose(read_dataset(folder), model, catalogue=[EFFECTS["spin_decay"]])
    assert not diagnosis.findings
    assert diagnosis.verdict is Verdict.UNEXPLAINED
    assert diagnosis.unexplained.where.startswith(f"{PREDICTED}: ")
    assert "noise expects" in headline(diagnosis)
