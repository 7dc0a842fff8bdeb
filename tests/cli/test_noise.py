"""`ballfg noise` as a user meets it: the table, the files, the messages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ballfg.dynamics import load_model
from ballfg.simulation import MeasurementNoise, SimulationConfig, write_simulation
from ballfg.tracks import read_dataset
from tests.commands import status


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("noise") / "shots"
    write_simulation(folder, SimulationConfig(8, 60.0, seed=2, noise=MeasurementNoise(memory=0.004, memory_time=0.03)))
    return folder


def test_table_and_files(shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "noisy.yaml"
    assert status("noise", shots, "--model", shots / "model.yaml", "--tracks", 8, "--out", out, "--write") == 0
    said = capsys.readouterr().out
    assert f"{shots}: noise from 8 tracks" in said
    assert "error of a position that lasts, along x" in said
    assert "90 % intervals of these forecasts hold" in said
    assert re.search(r"lasts, along x +([\d.]+) x/: ([\d.]+)  mm  \(([\d.]+) to ([\d.]+)\)", said)
    noise = load_model(out).noise
    assert noise is not None
    assert noise == read_dataset(shots).info.noise  # stated in both files now
    assert status("predict", shots, "--model", out, "--observe", 0.3, "--jobs", 1, "--out", tmp_path / "p.csv") == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere"),
        (["SHOTS", "--out", "SHOTS/dataset.yaml"], "out must be a model file"),
        (["SHOTS", "--tracks", "2"], "'--tracks'"),
    ],
)
def test_bad_input(shots: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str) -> None:
    assert status("noise", *(word.replace("SHOTS", str(shots)) for word in words)) == 2
    assert message in capsys.readouterr().err
