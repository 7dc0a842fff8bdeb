"""`ballfg diagnose` as a user meets it: what it prints and writes, what it refuses, and a whole run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

import ballfg.diagnosis
from ballfg.diagnosis.report.headline import headline
from ballfg.diagnosis.result import Diagnosis
from ballfg.dynamics import AnalyticModel, Architecture, build, load_model, nominal_model, save_model
from ballfg.progress import VARIABLE
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import Dataset
from tests.commands import printed, refused, status
from tests.diagnosis.made_diagnosis import found, silent, unexplained

Asked = list[tuple[str, tuple[str, ...], int]]
"""Dataset, flight effects of the model and jobs."""
Answer = Callable[[Diagnosis], Asked]
NAMES = ["model.yaml", "report.html", "report.json"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "shots"
    write_simulation(folder, SimulationConfig(tracks=8, rate=60.0, seed=2))
    return folder


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch) -> Answer:
    """answer(diagnosis): the search finds that; returns what the search was asked."""
    asked: Asked = []

    def answer(diagnosis: Diagnosis) -> Asked:
        def diagnose(
            dataset: Dataset,
            model: AnalyticModel,
            *,
            jobs: int = 1,
            watch: Callable[[str], None] | None = None,
            name_at: float = 0.0,
        ) -> Diagnosis:
            assert watch is not None
            assert name_at == 0.9
            watch("fitting the declared model to 25 tracks")
            asked.append((dataset.info.name, tuple(model.flight), jobs))
            return diagnosis

        monkeypatch.setattr(ballfg.diagnosis, "diagnose", diagnose)
        monkeypatch.setattr("ballfg.diagnosis.report.report.page", lambda diagnosis, origin: "<html></html>")
        return asked

    return answer


def test_what_is_printed_and_written(
    dataset: Path, tmp_path: Path, answer: Answer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE)
    asked = answer(found())
    out = tmp_path / "diagnosis"
    said = printed("diagnose", dataset, "--model", dataset / "model.yaml", "--out", out, "--jobs", 2)
    ((_, effects, jobs),) = asked
    assert (effects[:2], jobs) == (("gravity", "drag"), 2)
    assert said.err.startswith("fitting the declared model to 25 tracks\n")
    first, *lines = said.out.splitlines()
    assert first == headline(found())
    assert lines[0] == f"effect found: {found().sentence}"
    assert lines[2].split()[:4] == ["effect", "probability", "kind", "by"]
    assert lines[3].startswith("wind    99.8 % (one of them > 99.9 %)  flight  less than 1e-99  -598  gust_region")
    assert lines[5:8] == [
        "on 25 judging tracks  before  after",
        "prediction RMSE, mm   20.1    10.2",
        "apex RMSE, mm         12.1    –",
    ]
    assert "left out: shot 7 has no free flight of 10 samples." in lines
    assert lines[-1] == f"wrote report.html, report.json, model.yaml to {out}"
    assert sorted(path.name for path in out.iterdir()) == NAMES


def test_other_verdicts(dataset: Path, tmp_path: Path, answer: Answer) -> None:
    answer(silent())
    said = printed("diagnose", dataset, "--out", tmp_path / "a").out
    assert said.startswith(f"{headline(silent())}\nnothing lacking: Nothing is lacking")
    assert "effect " not in said
    answer(unexplained())
    assert "out must be new or empty; " in refused("diagnose", dataset, "--out", tmp_path / "a")
    assert json.loads((tmp_path / "a" / "report.json").read_text(encoding="utf-8"))["verdict"] == "nothing lacking"
    said = printed("diagnose", dataset, "--out", tmp_path / "a", "--force").out
    assert "left unexplained: In flight, along the motion" in said
    assert "  sparse terms: 0.31 t |v| v; prediction RMSE 11.8 mm with it" in said
    assert json.loads((tmp_path / "a" / "report.json").read_text(encoding="utf-8"))["verdict"] == "unexplained"


def test_a_learned_model_is_refused(dataset: Path, tmp_path: Path, answer: Answer) -> None:
    asked = answer(found())
    model = build(Architecture(kind="mnn+gs", width_flight=4, width_contact=4, depth=1), radius=0.02)
    save_model(model, tmp_path / "learned.yaml")
    out = tmp_path / "diagnosis"
    assert "--model must be analytic: a diagnosis adds physical effects to it; " in refused(
        "diagnose", dataset, "--model", tmp_path / "learned.yaml", "--out", out
    )
    assert not out.exists()
    assert asked == []


def test_places_that_are_refused(dataset: Path, tmp_path: Path, answer: Answer) -> None:
    asked = answer(found())
    before = sorted(dataset.iterdir())
    assert "out must not be the dataset itself; got " in refused("diagnose", dataset, "--out", dataset)
    (tmp_path / "notes.txt").write_text("mine")
    assert "out must be new, empty or hold an earlier report; " in refused("diagnose", dataset, "--out", tmp_path)
    out = tmp_path / "earlier"
    out.mkdir()
    save_model(nominal_model(), out / "model.yaml")
    (out / "report.json").write_text("{}")
    assert "out must not hold the model itself; " in refused(
        "diagnose", dataset, "--model", out / "model.yaml", "--out", out
    )
    assert status("diagnose", tmp_path / "nowhere", "--out", tmp_path / "new") == 2
    assert sorted(dataset.iterdir()) == before
    assert not (tmp_path / "new").exists()
    assert asked == []


def test_a_whole_run(dataset: Path, tmp_path: Path) -> None:
    """On tracks of the declared model: a report whose error is about the noise, and a model that can be read."""
    out = tmp_path / "diagnosis"
    said = printed("diagnose", dataset, "--model", dataset / "model.yaml", "--out", out, "--jobs", 1)
    # what was found out about the noise lies in a folder beside the model
    assert sorted(path.name for path in out.iterdir() if path.is_file()) == NAMES
    assert [path.name.split("-")[0] for path in out.iterdir() if path.is_dir()] == ["model.learned"]
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["verdict"] == "nothing lacking"
    assert report["effects"] == []
    assert 3.0 < report["error"]["before"]["prediction_rmse_mm"] < 60.0
    assert isinstance(load_model(out / "model.yaml"), AnalyticModel)
    assert "\nnothing lacking: " in said.out
