"""`ballfg noise` as a user meets it: the table, the files, the messages."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from ballfg.dynamics import load_model
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, write_simulation
from ballfg.tracks import TABLE_TENNIS, read_dataset
from ballfg.tracks.info import DatasetInfo, write_info
from ballfg.vision.camera_file import write_cameras
from tests.commands import printed, refused, status
from tests.estimation.observations.sighted_rig import RIG, TABLE, scene, world
from tests.written_tables import write_sightings


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("noise") / "shots"
    write_simulation(folder, SimulationConfig(8, 60.0, seed=2, noise=MeasurementNoise(memory=0.004, memory_time=0.03)))
    return folder


def test_table_and_files(shots: Path, tmp_path: Path) -> None:
    out = tmp_path / "noisy.yaml"
    said = printed("noise", shots, "--model", shots / "model.yaml", "--tracks", 8, "--out", out, "--write").out
    assert f"{shots}: noise from 8 tracks" in said
    assert "error of a position that lasts, along x" in said
    assert "90 % intervals of these forecasts hold" in said
    assert re.search(r"lasts, along x +([\d.]+) x/: ([\d.]+)  mm  \(([\d.]+) to ([\d.]+)\)", said)
    noise = load_model(out).noise
    assert noise is not None
    assert noise == read_dataset(shots).info.noise  # stated in both files now
    assert status("predict", shots, "--model", out, "--observe", 0.3, "--jobs", 1, "--out", tmp_path / "p.csv") == 0


@pytest.mark.thorough
def test_exact_positions_are_no_doubt_and_show_all_other_noise(tmp_path: Path) -> None:
    """Of another simulator, for instance: the positions are known to be better than any tracker's."""
    folder, process = tmp_path / "exact", MotionNoise(acceleration=0.05)
    config = SimulationConfig(8, 100.0, seed=3, noise=MeasurementNoise(position=1e-9), process=process)
    write_simulation(folder, config)
    write_info(folder / "dataset.yaml", replace(read_dataset(folder).info, position_noise=None))
    said = printed("noise", folder)
    assert "a filter smoothed" not in said.out + said.err
    white = re.findall(r"new in each sample.*\(below ([\d.]+)\)", said.out)
    assert len(white) == 3
    assert max(map(float, white)) < 0.05  # mm
    found = re.search(r"acceleration that the model lacks +([\d.]+)", said.out)
    assert found is not None
    assert float(found[1]) == pytest.approx(0.05, rel=0.2)


def test_written_noise_is_no_prior_of_the_next_one(shots: Path) -> None:
    """The same tracks are counted once, however often the noise is written: a prior of them would move every number."""
    said, stated = [], []
    before = (shots / "dataset.yaml").read_bytes()
    for _ in range(2):
        said.append(printed("noise", shots, "--model", shots / "model.yaml", "--tracks", 8, "--write").out)
        stated.append(read_dataset(shots).info.noise)
    assert stated[0] == stated[1]
    tables = [[line for line in lines.splitlines() if "so far" not in line] for lines in said]
    assert tables[0] == tables[1]
    found, assumed = re.findall(r"hold (\d+) %; with the noise assumed so far (\d+) %", said[1])[0]
    assert found == assumed  # what is written counts as assumed
    (shots / "dataset.yaml").write_bytes(before)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere"),
        (["SHOTS", "--out", "SHOTS/dataset.yaml"], "out must be a model file"),
        (["SHOTS", "--out", "SHOTS/truth.yaml"], "out must be a model file"),
        (["SHOTS", "--out", "SHOTS/tracks.csv"], "out must be a model file"),
        (["SHOTS", "--tracks", "2"], "'--tracks'"),
    ],
)
def test_bad_input(shots: Path, words: list[str], message: str) -> None:
    before = {path: path.read_bytes() for path in shots.iterdir()}
    assert message in refused("noise", *(word.replace("SHOTS", str(shots)) for word in words))
    assert {path: path.read_bytes() for path in shots.iterdir()} == before


def test_pixels_of_each_camera(tmp_path: Path) -> None:
    """Without a table of tracks no option is needed; neither a model file nor dataset.yaml could hold the noise."""
    write_info(tmp_path / "dataset.yaml", DatasetInfo("seen", TABLE, TABLE_TENNIS))
    write_cameras(tmp_path / "cameras.yaml", RIG)
    shots = [(name, scene(seed, world(), duration=0.3).sightings) for seed, name in enumerate(("one", "two"))]
    write_sightings(tmp_path / "detections.csv", shots)
    files = {path: path.read_bytes() for path in tmp_path.iterdir()}
    said = printed("noise", tmp_path).out
    assert "noise of pixels from 2 tracks" in said
    found = re.findall(
        r"camera (\w+), (\d+) sightings\n +error .*axis +([\d.]+) x/: ([\d.]+)  px  \(stated 0.3\)", said
    )
    assert [name for name, *_ in found] == [camera.name for camera in RIG]
    assert sum(int(count) for _, count, *_ in found) == sum(len(sightings) for _, sightings in shots)
    assert all(0.2 < float(sigma) < 0.4 and float(factor) < 1.15 for *_, sigma, factor in found)
    assert "streak" not in said
    for words in (["--write"], ["--from", "detections", "--out", tmp_path / "model.yaml"]):
        assert "--out and --write must be left out" in refused("noise", tmp_path, *words)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == files
