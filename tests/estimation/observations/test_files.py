"""Tables of readings beside the tracks of a dataset: written, read, refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from ballfg.estimation import RadarSpeed, SpinReading, read
from ballfg.estimation.observations.registry import read_readings
from ballfg.simulation import MeasurementNoise, SimulationConfig, write_simulation
from ballfg.tracks import Dataset, Track, read_dataset
from tests.written_tables import write_readings


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_simulation(tmp_path / "shots", SimulationConfig(2, 100.0, seed=1, noise=MeasurementNoise(position=0.002)))
    return tmp_path / "shots"


def with_readings(track: Track, seed: int) -> Track:
    rng = np.random.default_rng(seed)
    at = np.array([2, 5, 5, 9])
    delay = np.sort(rng.uniform(-1e-3, 1e-3, 4))
    speeds = RadarSpeed(at, rng.normal(6.0, 1.0, 4), rng.uniform(0.1, 0.2, 4), delay)
    return track.observed(speeds, SpinReading([4], rng.normal(0.0, 90.0, (1, 3)), 12.5))


def test_what_is_written_is_read_bit_for_bit(folder: Path) -> None:
    """But for the delay: the table has the time of a reading, which the sum with the stamp has rounded."""
    made = [with_readings(track, k) for k, track in enumerate(read_dataset(folder))]
    assert write_readings(folder, made) == [folder / "speeds.csv", folder / "spins.csv"]
    assert (folder / "speeds.csv").read_text().splitlines()[0] == "trajectory,t,speed,sigma"
    assert (folder / "spins.csv").read_text().splitlines()[0] == "trajectory,t,wx,wy,wz,sigma"
    found = read(folder)
    assert isinstance(found, Dataset)
    for expected, track in zip(made, found, strict=True):
        assert [one.name for one in track.observations] == ["speed", "spin"]
        for one, other in zip(track.observations, expected.observations, strict=True):
            assert one.values.tobytes() == other.values.tobytes()
            assert one.sigma.tobytes() == other.sigma.tobytes()
            np.testing.assert_array_equal(one.state, other.state)
            np.testing.assert_array_equal(track.times[one.state] + one.delay, track.times[one.state] + other.delay)
    texts = [(folder / name).read_bytes() for name in ("speeds.csv", "spins.csv")]
    write_readings(folder, found)
    assert [(folder / name).read_bytes() for name in ("speeds.csv", "spins.csv")] == texts


def test_tracks_without_readings_write_nothing(folder: Path) -> None:
    assert write_readings(folder, read_dataset(folder)) == []
    assert read(folder)[read_dataset(folder).names[0]].observations == ()


def test_readings_outside_of_the_track_are_left_out(folder: Path) -> None:
    first, second = read_dataset(folder)
    rows = [(first.times[0] - 0.01, 1.0), (first.times[0], 2.0), (first.times[-1], 3.0), (first.times[-1] + 0.01, 4.0)]
    lines = [f"{first.name},{t!r},{v},0.1" for t, v in rows]
    lines.append(f"{second.name},{second.times[-1] + 1.0!r},5.0,0.1")
    (folder / "speeds.csv").write_text("\n".join(["trajectory,t,speed,sigma", *map(plain, lines)]) + "\n")
    one, other = read(folder)
    (speeds,) = one.observations
    np.testing.assert_array_equal(speeds.values[:, 0], [2.0, 3.0])
    np.testing.assert_array_equal(speeds.state, [0, len(first) - 1])
    assert other.observations == ()


def plain(line: str) -> str:
    """Numbers without the name of their type."""
    return line.replace("np.float64(", "").replace(")", "")


def test_other_columns_are_told(folder: Path) -> None:
    track = next(iter(read_dataset(folder)))
    (folder / "speeds.csv").write_text(f"t,speed,trajectory,angle,sigma\n{track.times[3]},6,{track.name},12,0.1\n")
    found = read(folder)
    assert "speeds.csv: column 'angle' ignored" in found.notes
    (speeds,) = found[track.name].observations
    assert speeds.values.tolist() == [[6.0]]


HEADER = "trajectory,t,speed,sigma"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "trajectory,t,speed\n",
            "must have the columns trajectory, t, speed, sigma, each once; got 'trajectory,t,speed'",
        ),
        (f"{HEADER},t\n", "must have the columns trajectory, t, speed, sigma, each once"),
        (f"{HEADER}\n000,0.1,6.0\n", ", line 2: must have 4 cells; got 3. Complete the line."),
        (f"{HEADER}\n000,0.1,6.0,0.1\n0,0.1,6.0,0.1\n", ", line 3: trajectory '0' must have a track"),
        (f"{HEADER}\n000,0.1,fast,0.1\n", ", line 2, column 'speed': must be a number; got 'fast'"),
        (f"{HEADER}\n000,,6.0,0.1\n", ", line 2, column 't': must be a number; got ''"),
        (f"{HEADER}\n000,0.1,nan,0.1\n", ", line 2, column 'speed': must be a number; got 'nan'"),
        (f"{HEADER}\n000,0.1,6.0,0.0\n", ", line 2, column 'sigma': must be a positive number; got '0.0'"),
        (f"{HEADER}\n000,0.1,6.0,-1\n", ", line 2, column 'sigma': must be a positive number; got '-1'"),
        ("", ""),
    ],
)
def test_bad_tables_are_refused_with_their_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "speeds.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(str(path)) + ".*" + re.escape(message)):
        read_readings(tmp_path, ["000"])


def test_a_table_has_one_sigma_a_reading() -> None:
    track = Track(np.arange(3) / 100, np.zeros((3, 3)), name="000")
    with pytest.raises(ValueError, match="sigma of 'spin' must be one number a reading in a table"):
        SpinReading([0], [[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0]]).table(track)
