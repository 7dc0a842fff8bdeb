"""`ballfg design` as a user meets it: the table, the file, the messages."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

import ballfg.diagnosis
from ballfg.simulation import SimulationConfig, parse_effects, write_simulation
from tests.commands import printed, refused, status
from tests.diagnosis.made_diagnosis import silent

CANDIDATES = "topspin=-3..5:2,sidespin=-5..5:5,speed=8..14:2"


@pytest.fixture(scope="module")
def launched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("design") / "shots"
    write_simulation(folder, SimulationConfig(8, 60.0, seed=2))
    return folder


def test_table_and_file(launched: Path, tmp_path: Path) -> None:
    one, again = tmp_path / "one.csv", tmp_path / "again.csv"
    words = ["design", launched, "--candidates", CANDIDATES, "--between", "wind.x,drag.k", "--shots", 3, "--jobs", 1]
    said = printed(*words, "--out", one).out
    assert "3 of 60 candidates, for wind.x from drag.k" in said
    assert "random shots would bring as much as these 3" in said
    assert status(*words, "--out", again) == 0
    assert one.read_bytes() == again.read_bytes()
    with one.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["shot"] for row in rows] == ["1", "2", "3"]
    sigmas = [float(row["sigma_wind.x"]) for row in rows]
    assert sigmas == sorted(sigmas, reverse=True)
    assert all(float(row["topspin"]) in (-3, -1, 1, 3, 5) for row in rows)


def test_pairs_of_a_diagnosis(launched: Path, tmp_path: Path) -> None:
    finding = {"name": "frame_tilt", "indistinguishable_from": ["table_tilt", "a change of cameras"]}
    (tmp_path / "report.json").write_text(json.dumps({"effects": [finding]}))
    few = "topspin=-3..5:4,speed=8..14:6"
    words = ["design", launched, "--candidates", few, "--diagnosis", tmp_path, "--shots", 1, "--jobs", 1]
    assert "frame_tilt.x frame_tilt.y from table_tilt.x table_tilt.y" in printed(*words).out


@pytest.mark.thorough
def test_without_a_pair_the_dataset_is_diagnosed_first(tmp_path: Path) -> None:
    """Shots that fall too slowly: a clock that is wrong, or another g. The plan is that of the pair named by hand."""
    settings, slow = {"sidespin": [0], "speed": [11]}, tuple(parse_effects(["time_scale.s=0.015"]))
    write_simulation(tmp_path / "shots", SimulationConfig(8, 60.0, seed=4, settings=settings, undeclared=slow))
    words = ["design", tmp_path / "shots", "--candidates", "topspin=-3..5:2", "--shots", 2, "--jobs", 1]
    said = printed(*words, "--out", tmp_path / "diagnosed.csv")
    assert "2 of 5 candidates, for time_scale.s from gravity.g" in said.out
    assert "diagnosing the dataset" in said.err
    assert "time_scale added" in said.err
    assert status(*words, "--between", "time_scale,gravity", "--out", tmp_path / "named.csv") == 0
    assert (tmp_path / "diagnosed.csv").read_bytes() == (tmp_path / "named.csv").read_bytes()


def test_a_diagnosis_without_a_pair_is_refused(launched: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ballfg.diagnosis, "diagnose", lambda *_, **__: silent())
    out = tmp_path / "shots.csv"
    said = printed("design", launched, "--candidates", CANDIDATES, "--out", out, "--jobs", 1, status=2).err
    assert "nothing says what the shots are for: diagnosing the dataset" in said
    assert "the diagnosis names no pair of effects that it could not tell apart" in said
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--candidates", "wheel=1..2", "--shrink", "drag.k"], "'wheel' is none of them, there are: spin_x"),
        (["--candidates", "speed=8..x", "--shrink", "drag.k"], "must read NAME=LEVEL"),
        (["--candidates", "speed=8..9", "--between", "wind"], "two effects, separated by a comma; got 'wind'"),
        (["--candidates", "speed=8..9", "--between", "a,b", "--shrink", "c"], "exclude each other"),
        (["--candidates", "speed=8..9", "--diagnosis", "nowhere"], "must be a folder with report.json"),
        (["--candidates", "speed=8..9", "--shrink", "drag.k", "--out", "shots.txt"], ".csv or .parquet"),
        (["--candidates", "speed=8..9", "--shrink", "drag.k", "--shots", "0"], "shots must be 1 to 1000; got 0"),
        (["--candidates", "speed=8..9", "--between", "wind,darg"], "effect 'darg' is not known. Did you mean 'drag'"),
    ],
)
def test_mistakes(words: list[str], message: str, launched: Path) -> None:
    assert message in printed("design", launched, *words, "--jobs", 1, status=2).err.splitlines()[-1]


def test_a_report_without_a_pair(launched: Path, tmp_path: Path) -> None:
    for text, message in (
        ('{"effects": []}', "names no pair"),
        ('{"effects": [{"name": "gravity", "indistinguishable_from": ["buoyancy"]}]}', "names no pair"),
        ("{}", "is not the report of a diagnosis"),
    ):
        (tmp_path / "report.json").write_text(text)
        assert message in refused(
            "design", launched, "--candidates", "speed=8..9", "--diagnosis", tmp_path, "--jobs", 1
        )
