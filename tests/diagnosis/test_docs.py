"""The guide's catalogue is that of the registry, its examples run, and an effect of one's own is found."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import ballfg.diagnosis
from ballfg.diagnosis import fit_model, hold_out, hypotheses, scene_of, score_all, weigh
from ballfg.diagnosis.report.report import content
from ballfg.dynamics import EFFECTS, load_effects, load_model
from ballfg.simulation import SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import read_dataset
from tests.diagnosis.made_diagnosis import found
from tests.places import DOCS


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder; what is registered there is forgotten."""
    monkeypatch.chdir(tmp_path)
    with EFFECTS.restored():
        yield tmp_path


def test_report_has_the_keys_that_the_guide_shows() -> None:
    (text,) = blocks("diagnose.md", "json")
    shown, real = json.loads(text), content(found())
    assert shown.keys() == real.keys()
    for key in ("error", "unexplained"):
        assert shown[key].keys() == real[key].keys()
    assert shown["error"]["before"].keys() == real["error"]["before"].keys()
    assert shown["effects"][0].keys() == real["effects"][0].keys()
    assert shown["effects"][0]["parameters"]["x"].keys() <= real["effects"][0]["parameters"]["x"].keys()


def test_the_whole_from_python(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The guide's first example, with the answer given: tests/cli has a whole run."""
    asked = []

    def answer(dataset, model, *, jobs, watch):
        asked.append((len(dataset), list(model.flight), jobs))
        return found()

    monkeypatch.setattr("ballfg.diagnosis.diagnose", answer)
    monkeypatch.setattr("ballfg.diagnosis.report.report.page", lambda diagnosis, origin: "<html></html>")
    write_simulation("windy", SimulationConfig(tracks=6, rate=30.0))
    exec(compile(blocks("diagnose.md", "python")[1], "diagnose.md", "exec"), {})
    assert asked == [(6, ["gravity", "drag", "magnus"], 2)]
    assert json.loads((here / "diagnosis" / "report.json").read_text(encoding="utf-8"))["effects"]


def test_a_budget_from_python(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_simulation("windy", SimulationConfig(tracks=8, rate=60.0, seed=1))
    exec(compile(blocks("diagnose.md", "python")[0], "diagnose.md", "exec"), {})
    said = capsys.readouterr().out
    assert "noise of the observed part" in said
    assert "mm that the model with its noise expects" in said


@pytest.mark.thorough
def test_the_pieces_from_python(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict = {}
    exec(compile(blocks("diagnose.md", "python")[2], "diagnose.md", "exec"), names)
    assert names["scored"][0].hypothesis.name == "wind"
    assert names["after"].fit.unknowns.values["flight.wind.y"] == pytest.approx(0.5, abs=0.15)
    assert names["after"].delta_bic < -50.0
    assert "estimating 12 tracks" in capsys.readouterr().out


def test_the_guide_lists_every_function_of_the_room() -> None:
    text = (DOCS / "diagnose.md").read_text(encoding="utf-8")
    table = text[text.index("| function | does |") :].split("\n\n")[0]
    rows = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \|", table, re.MULTILINE)
    shown = {name for row in rows for name in re.findall(r"\w+", row)}
    assert shown == {name for name in ballfg.diagnosis.__all__ if name.islower()}


def test_an_effect_of_ones_own_is_found(here: Path) -> None:
    """The file of the other guide: tracks are simulated with it, and it is what explains them best."""
    Path("static_charge.py").write_text(blocks("add_an_effect.md", "python")[0], encoding="utf-8")
    (charge,) = load_effects("static_charge.py")
    effect = parse_effects(["static_charge.strength=3"])
    write_simulation("charged", SimulationConfig(tracks=8, rate=60.0, seed=3, undeclared=effect))
    model = load_model("charged/model.yaml")
    holdout = hold_out(read_dataset("charged"), model)
    before = fit_model(model, holdout.search, holdout.settings, settle_noise=False)
    candidates = hypotheses(model, scene_of(before), [charge, EFFECTS["wind"], EFFECTS["drag_speed"]])
    assert [h.shape["reach"] for h in candidates[:2]] == [0.05, 0.15]
    best = score_all(weigh(before), candidates)[0]
    assert best.hypothesis.effect is charge
    assert best.score is not None
    assert best.gain > 10.0  # nats, which decide; the p-value trusts the stated noise
    assert best.p_value < 0.01
    assert np.abs(best.score.estimate - 3.0)[0] < 6.0 * best.score.sigma[0] + 1.0  # its reach is tried, not known
