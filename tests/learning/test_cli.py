from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

import ballfg as bf
from ballfg.cli.main import run as ballfg
from ballfg.dynamics import EFFECTS, load_model
from ballfg.estimation.observations.registry import OBSERVATIONS
from ballfg.learning.calibration import run as calibration
from ballfg.learning.calibration.coefficients import values_of
from ballfg.learning.cli import run
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.training import run_training
from ballfg.learning.sequence.predictor import SequencePredictor
from ballfg.progress import unwatched

SHORT = ("max_iterations=2", "tolerance=1e-12", "jobs=1", "coefficients=[flight.drag.k,bounce.restitution.e]")


def status(*words: object, command: Any = run) -> int:
    with pytest.raises(SystemExit) as ended:
        command([str(word) for word in words])
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "calibrate.yaml"
    path.write_text("kind: calibrate\nseed: 1\n")
    return path


@pytest.fixture(scope="module")
def finished(config: Path, few_tracks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "run"
    assert status(config, *SHORT, "--data", few_tracks, "--out", out) == 0
    return out


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_sequence_model_is_for_python_alone(
    few_tracks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last lines of its training say what reads it, and so do commands that get it."""
    settings = TrainConfig.model_validate(
        {"kind": "lstm", "data": [str(few_tracks)], "observe": {"samples": 25}, "optimizer": {"epochs": 1}, "jobs": 1}
    )
    run_training(settings, tmp_path / "run", watch=unwatched)
    model = tmp_path / "run" / "model"
    reader = "SequencePredictor.load of ballfg.learning.sequence.predictor"
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith(f"{model}: "))
    assert line.endswith(f", for {reader}; no command reads it")
    assert SequencePredictor.load(model).architecture.kind == "lstm"
    options = ("--observe", 0.3, "--model", model, "--out", tmp_path / "p.csv")
    assert status("predict", few_tracks, *options, command=ballfg) == 2
    assert f"{model} is a folder. It holds weights: " in (said := capsys.readouterr().err)
    assert f"Models of kind lstm or diffusion have none: {reader} reads them" in said


def test_a_run_writes_all_its_files(finished: Path, few_tracks: Path, tmp_path: Path) -> None:
    assert names(finished) == sorted(files.CALIBRATION)
    resolved = yaml.safe_load((finished / "config.yaml").read_text())
    assert (resolved["seed"], resolved["max_iterations"], resolved["data"]) == (1, 2, str(few_tracks))
    assert {"python", "ballfg", "torch", "gtsam"} <= set(json.loads((finished / "versions.json").read_text()))
    report = json.loads((finished / "report.json").read_text())
    assert report["iterations"] == 2
    assert report["fitted"]["tracks"] == report["judged"]["tracks"] == 3
    drag = report["coefficients"]["flight.drag.k"]
    assert drag["before"] == 0.12
    assert drag["unit"] == "1/m"
    model = load_model(finished / "model.yaml")
    assert values_of(model, ["flight.drag.k"]).tolist() == [drag["after"]]
    assert "Median RMSE" in report["verdict"]
    picture = (finished / "calibration.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    panels = len(report["coefficients"]) + 1
    assert struct.unpack(">II", picture[16:24]) == (panels * 520, 507)  # side by side, none of them empty
    predictions = tmp_path / "p.csv"
    words = ("predict", few_tracks, "--model", finished / "model.yaml", "--observe", 0.25, "--out", predictions)
    assert status(*words, "--jobs", 1, command=ballfg) == 0


def interrupt_after(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    real = calibration.write_checkpoint

    def write(folder: Path, problem: Any, done: list[Any]) -> None:
        real(folder, problem, done)
        if len(done) == steps:
            raise KeyboardInterrupt

    monkeypatch.setattr(calibration, "write_checkpoint", write)


def test_ctrl_c_keeps_the_checkpoint_and_a_resumed_run_ends_the_same(
    config: Path, few_tracks: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        interrupt_after(patch, 2)
        assert status(config, *SHORT, "--data", few_tracks, "--out", out) == 130
    assert names(out) == ["checkpoint.json", "config.yaml", "versions.json"]
    said = capsys.readouterr()
    assert f"continue with --resume {out}" in said.err
    assert "iteration 0: flight.drag.k 0.12" in said.out
    assert status(config, *SHORT, "--data", few_tracks, "--resume", out) == 0
    said = capsys.readouterr()
    assert "iteration 1" not in said.out
    assert "iteration 2" in said.out
    for name in ("checkpoint.json", "report.json", "model.yaml"):
        assert (out / name).read_bytes() == (finished / name).read_bytes(), name
    assert names(out) == sorted(files.CALIBRATION)


def complaints(said: str) -> list[str]:
    """The lines that are no notes on the dataset."""
    return [line for line in said.splitlines() if not line.startswith("note: ")]


def test_resume_refuses_another_run(
    config: Path, few_tracks: Path, no_spin_labels: Path, finished: Path, tmp_path: Path, capsys: Any
) -> None:
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    before = {name: (out / name).read_bytes() for name in names(out)}
    model = tmp_path / "other.yaml"
    model.write_text((finished / "model.yaml").read_text())
    given = (config, *SHORT, "--data", few_tracks)
    for words, message in (
        ((*given, "--resume", out, "seed=2"), "'seed' was 1 and is 2"),
        ((config, *SHORT, "--data", no_spin_labels, "--resume", out), "was made from another dataset"),
        ((*given, "--resume", out, f"model={model}"), "was started from another model"),
        ((config, *given[1:], "--resume", out, "kind=mlp"), "unknown key 'max_iterations'"),
        ((config, "--data", few_tracks, "--resume", out, "kind=mlp"), "'kind' was 'calibrate' and is 'mlp'"),
        ((*given, "--data", few_tracks, "--resume", out), "'data' was"),
        ((*given, "--resume", tmp_path / "none"), "needs the folder of an earlier run"),
        ((*given, "--resume", out, "--out", tmp_path / "else"), "must name one folder"),
        ((*given, "--out", out), f"continue that run with --resume {out}"),
    ):
        assert status(*words) == 2
        said = capsys.readouterr()
        assert message in said.err
        assert len(complaints(said.err)) == 1
    assert {name: (out / name).read_bytes() for name in names(out)} == before
    kept = json.loads((out / "checkpoint.json").read_text())
    kept["steps"][0]["mean"].append(1.0)
    (out / "checkpoint.json").write_text(json.dumps(kept))
    assert status(*given, "--resume", out) == 2
    assert "its steps are not those of this run" in capsys.readouterr().err
    (out / "checkpoint.json").write_text('{"data": 1}')
    assert status(*given, "--resume", out) == 2
    assert "not a checkpoint" in capsys.readouterr().err


RADIAL = """from ballfg.estimation import Reading


class Across(Reading):
    name, file, columns = "across", "across.csv", ("vy",)

    def predicted(self, state):
        return state[..., 4:5]
"""
PULL = """import torch

from ballfg.dynamics import Coefficient, FlightEffect


class Pull(FlightEffect):
    name, sentence, decide = "pull", "Something pulls.", "Remove it."
    coefficients = (Coefficient("a", 0.0, 0.1, "m/s^2", -5.0, 5.0),)

    def acceleration(self, flight):
        return self.a * torch.ones_like(flight.velocity)
"""


def test_effects_and_observations_of_one_s_own_reach_every_process(few_tracks: Path, tmp_path: Path) -> None:
    shutil.copytree(few_tracks, tmp_path / "shots")
    rows = ["trajectory,t,vy,sigma", *(f"{name},0.1,0.0,0.1" for name in bf.read(few_tracks).names)]
    (tmp_path / "shots" / "across.csv").write_text("\n".join(rows) + "\n")
    model = "{flight: {gravity: {}, drag: {}, magnus: {}, pull: {a: 0.01}}, bounce: {restitution: {}, friction: {}}}"
    for name, text in (("across.py", RADIAL), ("pull.py", PULL), ("model.yaml", model), ("a.yaml", "kind: a-tune\n")):
        (tmp_path / name).write_text(text)
    keys = ("observe.samples=25", "augment=false", "optimizer.epochs=1", "jobs=2", f"model={tmp_path / 'model.yaml'}")
    given = (tmp_path / "a.yaml", *keys, "--data", tmp_path / "shots", "--out", tmp_path / "run")
    files = ("--effects-file", tmp_path / "pull.py", "--observations-file", tmp_path / "across.py")
    with EFFECTS.restored(), OBSERVATIONS.restored():
        assert status(*given, *files) in (0, 1)
        assert load_model(tmp_path / "run" / "model.yaml").flight["pull"].values()["a"] == pytest.approx(0.01, abs=0.1)


def test_bad_input_is_one_line_and_writes_nothing(
    config: Path, few_tracks: Path, no_spin_labels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    (tmp_path / "file").write_text("")
    for words, message in (
        ((config, "--out", out), "a dataset is needed; got none. Give --data FOLDER"),
        ((config, "--out", out, "--data", tmp_path / "none"), "none does not"),
        ((tmp_path / "none.yaml", "--out", out), "none.yaml does not exist"),
        ((config, "sed=1", "--out", out), "Did you mean 'seed'?"),
        ((config, "--out", out, "--data", "a", "kind=mpl"), "'kind' must be 'a-tune'"),
        ((config, "model=none.yaml", "--data", few_tracks, "--out", out), "model file none.yaml does not exist"),
        ((config, "coefficients=[flight.magnus.k]", "--data", no_spin_labels, "--out", out), "spin labels"),
        ((config, "split=label", "--data", few_tracks, "--out", out), "needs a column 'split'"),
        ((config, "--data", few_tracks, "--out", tmp_path / "file"), "out must be a folder"),
        ((config, "--bogus"), "--bogus"),
        ((), "CONFIG"),
    ):
        assert status(*words) == 2
        said = capsys.readouterr()
        (complaint,) = complaints(said.err)
        assert complaint.startswith("ballfg: error: ")
        assert message in complaint
    assert not out.exists()


def test_a_crash_while_writing_leaves_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files.write_json(tmp_path / "checkpoint.json", {"a": 1})
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("no space")))
    with pytest.raises(OSError, match="no space"):
        files.write_json(tmp_path / "checkpoint.json", {"a": 2})
    assert json.loads((tmp_path / "checkpoint.json").read_text()) == {"a": 1}


def test_help_has_an_example_and_does_not_wait(capsys: pytest.CaptureFixture[str]) -> None:
    assert status("--help") == 0
    assert "Example: ballfg-train train.yaml --data" in " ".join(capsys.readouterr().out.split())
    heavy = ("torch", "gtsam", "numpy", "pydantic", "matplotlib")
    code = f"import sys, ballfg.learning.cli; sys.exit(any(name in sys.modules for name in {heavy}))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
