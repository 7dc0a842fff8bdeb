"""`ballfg simulate` as a user meets it: files, messages, exit statuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from ballfg.tracks import read_dataset
from ballfg.tracks.info import TENNIS
from tests.commands import printed, refused, status


def test_writes_a_dataset_and_says_where(tmp_path: Path) -> None:
    out = tmp_path / "windy"
    said = printed("simulate", "--out", out, "--tracks", 4, "--effect", "wind.x=0.3", "--format", "parquet")
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
def test_bad_input_is_one_line_and_status_2(tmp_path: Path, options: list[str], message: str) -> None:
    assert message in refused("simulate", "--out", tmp_path / "d", *options)
    assert list(tmp_path.iterdir()) == []


def test_missing_option_and_unknown_command() -> None:
    assert "--out" in refused("simulate")
    assert "simulat" in refused("simulat")


def test_a_second_run_needs_force(tmp_path: Path) -> None:
    command = ["simulate", "--out", tmp_path / "d", "--tracks", 2]
    assert status(*command) == 0
    assert "Replace it with --force" in refused(*command)
    assert status(*command, "--force") == 0


def test_ctrl_c_exits_130_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ballfg.cli.commands.simulate.progress", interrupt)
    assert "interrupted" in printed("simulate", "--out", tmp_path / "d", "--tracks", 2, status=130).err
    assert list(tmp_path.iterdir()) == []
