"""`ballfg simulate` as a user meets it: files, messages, exit statuses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ballfg.tracks import read_dataset
from ballfg.tracks.info import TENNIS
from tests.commands import status


def test_writes_a_dataset_and_says_where(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "windy"
    assert status("simulate", "--out", out, "--tracks", 4, "--effect", "wind.x=0.3", "--format", "parquet") == 0
    said = capsys.readouterr()
    assert f"wrote 4 tracks to {out}" in said.out
    assert "undeclared effects: wind" in said.out
    assert said.err == ""
    assert len(read_dataset(out)) == 4


def test_options_reach_the_simulation(tmp_path: Path) -> None:
    out = tmp_path / "d"
    options = ["--seed", 3, "--rate", 50, "--settings", "topspin=-3,speed=9", "--no-spin-labels", "--noise", 0.001]
    assert status("simulate", "--out", out, "--tracks", 11, *options) == 0
    dataset = read_dataset(out)
    assert (dataset.info.rate, dataset.info.position_noise) == (50.0, 0.001)
    assert {(t.labels["topspin"], t.labels["speed"]) for t in dataset} == {(-3.0, 9.0)}
    assert {t.labels["sidespin"] for t in dataset} == {float(s) for s in range(-5, 6)}


def test_other_balls_and_models(tmp_path: Path) -> None:
    assert status("simulate", "--out", tmp_path / "tennis", "--ball", "tennis", "--tracks", 2) == 0
    assert read_dataset(tmp_path / "tennis").info.ball == TENNIS
    model = tmp_path / "tennis" / "model.yaml"
    assert status("simulate", "--out", tmp_path / "again", "--model", model, "--tracks", 2) == 0
    assert (tmp_path / "again" / "model.yaml").read_bytes() == model.read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--effect", "wnd.x=1"], "Did you mean 'wind'"),
        (["--tracks", "0"], "tracks must lie in 1"),
        (["--tracks", "many"], "'--tracks'"),
        (["--noise", "-1"], "position must be at least 0"),
        (["--ball", "squash"], "ball must be "),
        (["--model", "none.yaml"], "none.yaml does not exist"),
        (["--format", "xls"], "'csv' or 'parquet'; got 'xls'"),
        (["--settings", "topspin=9"], "topspin must lie in -3 .. 5; got 9"),
        (["--bogus"], "--bogus"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert status("simulate", "--out", tmp_path / "d", *options) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("ballfg: error: ")
    assert said.err.count("\n") == 1
    assert message in said.err
    assert list(tmp_path.iterdir()) == []


def test_missing_option_and_unknown_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert status("simulate") == 2
    assert "--out" in capsys.readouterr().err
    assert status("simulat") == 2
    assert "simulat" in capsys.readouterr().err


def test_a_second_run_needs_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["simulate", "--out", tmp_path / "d", "--tracks", 2]
    assert status(*command) == 0
    assert status(*command) == 2
    assert "Replace it with --force" in capsys.readouterr().err
    assert status(*command, "--force") == 0


def test_ctrl_c_exits_130_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ballfg.cli.commands.simulate.progress", interrupt)
    assert status("simulate", "--out", tmp_path / "d", "--tracks", 2) == 130
    assert "interrupted" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [[], ["--help"], ["simulate", "--help"]])
def test_help(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    assert status(*arguments) == 0
    said = capsys.readouterr().out
    assert "simulate" in said
    if len(arguments) == 2:
        assert "Example: ballfg simulate --out" in said


def test_help_does_not_wait_for_the_heavy_libraries() -> None:
    heavy = ("torch", "gtsam", "numpy", "pyarrow")
    code = f"import sys, ballfg.cli.main; sys.exit(any(name in sys.modules for name in {heavy}))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
