"""`--observations-file FILE.py` as a user meets it: a table of one's own is read; one that nobody claims is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ballfg.estimation import read
from ballfg.estimation.observations.registry import OBSERVATIONS, load_observations
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate, write_simulation
from ballfg.tracks import TableWriter
from tests.commands import printed, refused, status
from tests.test_plug_in_package import OBSERVATION


@pytest.fixture
def shots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset of two shots with a table of heights, exact to 0.1 mm, and the file of its observation."""
    monkeypatch.chdir(tmp_path)
    config = SimulationConfig(2, 100.0, seed=3, noise=MeasurementNoise(position=0.004))
    write_simulation(tmp_path / "shots", config)
    with TableWriter(tmp_path / "shots" / "heights.csv") as table:
        for shot in simulate(config):
            n = len(shot.track)
            table.write(
                {
                    "trajectory": shot.track.name,
                    "t": shot.track.times,
                    "height": shot.true_states[:, 2],
                    "sigma": np.full(n, 1e-4),
                }
            )
    (tmp_path / "laser.py").write_text(OBSERVATION, encoding="utf-8")
    return tmp_path / "shots"


COMMANDS = {
    "estimate": ("estimate", "shots", "--jobs", "1", "--out", "out.csv"),
    "predict": ("predict", "shots", "--observe", "0.2", "--jobs", "1", "--out", "out.csv"),
    "diagnose": ("diagnose", "shots", "--out", "diagnosis"),
    "noise": ("noise", "shots"),
    "live": ("live", "--replay", "shots", "--out", "out.jsonl", "--speed", "0"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_table_that_no_observation_claims_is_refused_in_one_line(command: str, shots: Path) -> None:
    before = sorted(shots.parent.iterdir())
    with OBSERVATIONS.restored():
        said = refused(*COMMANDS[command])
    assert "heights.csv must belong to an observation" in said
    assert "--observations-file" in said
    assert sorted(shots.parent.iterdir()) == before
    with pytest.raises(ValueError, match=r"heights\.csv must belong"):
        read(shots)


def heights(path: Path) -> np.ndarray:
    columns = path.read_text().splitlines()[0].split(",")
    return np.loadtxt(path, delimiter=",", skiprows=1, usecols=(columns.index("z"), columns.index("sigma_z")))


def test_an_observation_in_a_file_is_used_by_the_estimate(shots: Path) -> None:
    truth = np.concatenate(
        [s.true_states[:, 2] for s in simulate(SimulationConfig(2, 100.0, seed=3, noise=MeasurementNoise(0.004)))]
    )
    with OBSERVATIONS.restored():
        assert status(*COMMANDS["estimate"], "--observations-file", "laser.py") == 0
    found = heights(Path("out.csv"))
    assert np.abs(found[:, 0] - truth).max() < 1e-3  # positions alone have 4 mm
    assert found[:, 1].max() < 3e-4


@pytest.mark.parametrize("command", ["predict", "noise", "live"])
def test_the_other_commands_take_the_file_too(command: str, shots: Path) -> None:
    with OBSERVATIONS.restored():
        said = printed(*COMMANDS[command], "--observations-file", "laser.py").err
    if command == "live":
        assert "note: heights.csv is not used: live estimates are made from positions alone" in said


def test_the_sliding_window_says_that_it_uses_positions_alone(shots: Path) -> None:
    with OBSERVATIONS.restored():
        said = printed(*COMMANDS["estimate"], "--method", "sliding-window", "--observations-file", "laser.py")
    assert "observations beside positions are not used" in said.out + said.err


def test_tables_that_are_no_readings_may_lie_beside_the_tracks(shots: Path) -> None:
    (shots / "heights.csv").rename(shots.parent / "heights.csv")
    (shots / "notes.csv").write_bytes(b"\xff\xfe\x00\nnonsense")
    (shots / "empty.csv").write_bytes(b"")
    assert status("estimate", "shots", "--jobs", "1", "--out", "shots/states.csv") == 0
    assert status("predict", "shots", "--observe", "0.2", "--jobs", "1", "--out", "shots/predictions.csv") == 0
    assert len(list(read(shots))) == 2


def test_a_file_without_an_observation_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.py"
    with pytest.raises(FileNotFoundError, match="observations file"):
        load_observations(broken)
    broken.write_text("from ballfg.estimation import Reading\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must define an observation"):
        load_observations(broken)
    broken.write_text("1 / 0\n", encoding="utf-8")
    with pytest.raises(ValueError, match="line 1: ZeroDivisionError"):
        load_observations(broken)
