"""Diagnoses of strokes of one camera: planted errors by name and strength, the report, and what is refused."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import pytest

import ballfg as bf
from ballfg.benchmarks.cameras.strokes import MODEL, SETTINGS, SURFACES
from ballfg.diagnosis import write_report
from ballfg.diagnosis.fit.effects import with_effects
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.one_view.diagnosis import diagnose_one_view, errors_across, told, with_values
from ballfg.diagnosis.one_view.picture import CLOCK, ERRORS, LENS, Picture
from ballfg.diagnosis.one_view.search import Found
from ballfg.diagnosis.one_view.strokes import Laws, all_estimated
from ballfg.diagnosis.one_view.weights import Weights, odds_of
from ballfg.diagnosis.result import Outcome, Verdict
from ballfg.dynamics import EFFECTS, BallModel, load_model
from ballfg.estimation import read_sighted
from ballfg.tracks import Track
from tests.commands import status
from tests.diagnosis.one_view.filmed import strokes, write_folder

DRAG: Final = "flight.drag.k"


def found_clock(tracks: list[Track]) -> Found:
    """The end of a search about laws with a clock that runs wrong by 4 %, whose scores say so beyond doubt."""
    clock, lens = (Hypothesis(error, {}, (error.coefficients[0].name,)) for error in (ERRORS[0], ERRORS[2]))
    drag = float(MODEL.get_parameter(DRAG).detach())
    sizes, values = {DRAG: 0.035, CLOCK: 0.01, LENS: 0.05}, {DRAG: drag, CLOCK: 0.04, LENS: 0.0}
    laws = Laws(MODEL, SURFACES, SETTINGS, sizes, values)
    arrays = (np.array(list(sizes.values())), np.array(list(values.values())), np.array([drag, 0.0, 0.0]))
    weights = Weights(tuple(sizes), *arrays, 1, np.zeros(3), 0.01 * np.eye(3), np.eye(3), len(tracks), (clock, lens))
    (stroke, *rest) = all_estimated(laws, tracks, 1)
    best = weights.weighed((clock,))
    return Found(laws, weights, best, odds_of([weights]), (stroke, *rest), {DRAG: drag}, weights.weighed(()))


def test_what_is_told_of_a_clock(tmp_path: Path) -> None:
    """The finding, its strength, predictions with right stamps, and a page without a word on positions."""
    tracks = strokes(6, 5, picture=Picture(clock=0.04))
    found = found_clock(tracks)
    predicted = partial(errors_across, tracks=tracks, surfaces=SURFACES, settings=SETTINGS, jobs=1)
    diagnosis = told(found, MODEL, tracks, "strokes", predicted, 0.9)
    (finding,) = diagnosis.findings
    assert (finding.name, finding.kind, diagnosis.verdict) == ("time_scale", "measurement", Verdict.FOUND)
    assert finding.parameters["s"].value == pytest.approx(0.04, abs=2e-3)
    assert finding.probability == pytest.approx(found.odds.of("time_scale"))
    assert [c.outcome for c in diagnosis.rounds[0]] == [Outcome.ADDED, Outcome.NOT_NEEDED]
    assert diagnosis.before.prediction_rmse_mm == predicted(MODEL, Picture()).prediction_rmse_mm
    right = predicted(MODEL, Picture(clock=finding.parameters["s"].value))
    assert diagnosis.after.prediction_rmse_mm == pytest.approx(right.prediction_rmse_mm, rel=0.01)
    write_report(diagnosis, tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["effects"][0]["held_out_gain"] is None
    assert report["error"]["tracks_judged_on"] == 6
    page = (tmp_path / "out" / "report.html").read_text()
    assert "those across the rays" in page
    assert "held-out tracks the first" not in page
    assert "model.yaml does not hold time_scale" in page
    model = load_model(tmp_path / "out" / "model.yaml")
    assert set(dict(model.named_parameters())) == set(dict(MODEL.named_parameters()))


def test_an_effect_of_the_air_is_in_the_corrected_model() -> None:
    model = with_values(MODEL, {DRAG: 0.13, "flight.wind.x": 0.4}, [EFFECTS["wind"](x=0.0)])
    assert float(model.get_parameter("flight.wind.x").detach()) == 0.4
    assert float(model.get_parameter(DRAG).detach()) == 0.13
    assert float(MODEL.get_parameter(DRAG).detach()) == 0.12


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "truth", "picture"),
    [
        ("wind", with_effects(MODEL, EFFECTS["wind"](x=0.5)), Picture()),
        ("time_scale", MODEL, Picture(clock=0.04)),
        ("distortion", MODEL, Picture(lens=-0.1)),
        (None, MODEL, Picture()),
    ],
)
def test_sixty_strokes(name: str | None, truth: BallModel, picture: Picture, tmp_path: Path) -> None:
    """What was planted is named alone, with its strength; nothing is where nothing is."""
    data = write_folder(tmp_path / "data", strokes(60, 77, truth, picture))
    found = diagnose_one_view(read_sighted(data), MODEL, jobs=2)
    assert [finding.name for finding in found.findings] == ([] if name is None else [name])
    if name is None:
        assert found.verdict is Verdict.NOTHING
        assert found.nothing_lacking > 0.5
    planted = {"wind": {"x": 0.5}, "time_scale": {"s": 0.04}, "distortion": {"k1": -0.1}}.get(name or "", {})
    for coefficient, value in planted.items():
        got = found.findings[0].parameters[coefficient]
        assert abs(got.value - value) < 4.0 * got.sigma


def test_too_few_strokes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In one line, with the number, and without an output."""
    data = write_folder(tmp_path / "data", strokes(6, 5))
    assert status("diagnose", str(data), "--out", str(tmp_path / "out"), "--jobs", "1") == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "needs 20 of them" in said
    assert "got 6 of 6" in said
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="needs 20 of them"):
        bf.diagnose(data)
