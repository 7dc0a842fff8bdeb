"""Simulated datasets as files: reproducible, readable, with the truth beside them and nothing of it inside."""

from __future__ import annotations

import csv
import gc
import tracemalloc
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

from ballfg.dynamics import load_model, nominal_model
from ballfg.dynamics.model_file import model_to_dict
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, parse_effects, simulate, write_simulation
from ballfg.simulation.synthetic import SimulatedTrack
from ballfg.state import STATE_NAMES
from ballfg.tracks import read_dataset

EVERYTHING = SimulationConfig(
    tracks=20,
    seed=4,
    noise=MeasurementNoise(dropout=0.1, jitter=0.0005, outliers=0.02),
    process=MotionNoise(0.1, 1.0, 0.02, 2.0),
    undeclared=parse_effects(["wind.x=0.3", "scale.z=0.01"]),
)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("file_format", ["csv", "parquet"])
def test_same_seed_same_bytes(tmp_path: Path, file_format: str) -> None:
    for name in ("a", "b"):
        write_simulation(tmp_path / name, EVERYTHING, file_format)  # type: ignore[arg-type]
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert set(contents(tmp_path / "a")) == {
        "dataset.yaml",
        "labels.csv",
        "model.yaml",
        "truth.yaml",
        f"tracks.{file_format}",
        f"truth.{file_format}",
    }


def test_another_seed_gives_other_tracks(tmp_path: Path) -> None:
    for seed in (1, 2):
        write_simulation(tmp_path / str(seed), SimulationConfig(tracks=3, seed=seed))
    assert contents(tmp_path / "1")["tracks.csv"] != contents(tmp_path / "2")["tracks.csv"]


def test_dataset_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    write_simulation(tmp_path / "d", EVERYTHING)
    dataset = read_dataset(tmp_path / "d")
    assert dataset.notes == []
    assert (dataset.info.position_noise, dataset.info.spin_noise, dataset.info.rate) == (0.003, 4.0, 100.0)
    assert dataset.label_names == ["spin_x", "spin_y", "spin_z", "topspin", "sidespin", "speed"]
    for read, made in zip(dataset, simulate(EVERYTHING), strict=True):
        assert read.name == made.track.name
        np.testing.assert_array_equal(read.times, made.track.times)
        np.testing.assert_array_equal(read.positions, made.track.positions)
        assert read.labels == made.track.labels


def test_truth_has_one_row_per_stamp(tmp_path: Path) -> None:
    write_simulation(tmp_path / "d", EVERYTHING)
    with (tmp_path / "d" / "truth.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["trajectory", "t", "t_true", *STATE_NAMES]
    with (tmp_path / "d" / "tracks.csv").open(newline="") as file:
        keys = [(row["trajectory"], row["t"]) for row in csv.DictReader(file)]
    assert [(row["trajectory"], row["t"]) for row in rows] == keys
    made = [t for t in simulate(EVERYTHING)]
    states = np.array([[float(row[name]) for name in STATE_NAMES] for row in rows])
    np.testing.assert_array_equal(states, np.concatenate([t.true_states for t in made]))
    np.testing.assert_array_equal([float(row["t_true"]) for row in rows], np.concatenate([t.true_times for t in made]))


def test_truth_of_a_clock_that_runs_wrong_has_the_true_times(tmp_path: Path) -> None:
    """Frames are 10 ms apart, their stamps 10.1 ms: the true velocity belongs to the true times."""
    clock = SimulationConfig(tracks=2, seed=4, undeclared=parse_effects(["time_scale.s=0.01"]))
    write_simulation(tmp_path / "d", clock)
    with (tmp_path / "d" / "truth.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["trajectory"] == "000"][:3]
    t, t_true, x = (np.array([float(row[name]) for row in rows]) for name in ("t", "t_true", "x"))
    np.testing.assert_allclose(t, [0.0, 0.0101, 0.0202], rtol=1e-12)
    np.testing.assert_allclose(t_true, [0.0, 0.01, 0.02], rtol=1e-12)
    assert (x[2] - x[0]) / (t_true[2] - t_true[0]) == pytest.approx(float(rows[1]["vx"]), rel=1e-4)


def test_truth_without_jitter_has_one_time(tmp_path: Path) -> None:
    write_simulation(tmp_path / "d", SimulationConfig(tracks=2), "parquet")
    assert pq.read_table(tmp_path / "d" / "truth.parquet").column_names == ["trajectory", "t", *STATE_NAMES]


def test_undeclared_effects_stand_in_the_truth_only(tmp_path: Path) -> None:
    write_simulation(tmp_path / "d", EVERYTHING)
    truth = yaml.safe_load((tmp_path / "d" / "truth.yaml").read_text())
    assert truth["undeclared"]["wind"]["values"] == {"x": 0.3, "y": 0.0, "z": 0.0}
    assert truth["undeclared"]["wind"]["units"]["x"] == "m/s"
    assert truth["undeclared"]["scale"]["kind"] == "measurement"
    assert truth["seed"] == 4
    assert truth["process_noise"]["acceleration"] == 0.1
    assert truth["model"] == model_to_dict(nominal_model())
    for name in ("dataset.yaml", "labels.csv", "model.yaml"):
        text = (tmp_path / "d" / name).read_text()
        assert "wind" not in text
        assert "scale" not in text


def test_declared_model_is_written_for_other_commands(tmp_path: Path) -> None:
    write_simulation(tmp_path / "d", EVERYTHING)
    assert model_to_dict(load_model(tmp_path / "d" / "model.yaml")) == model_to_dict(nominal_model())


def test_folders_that_are_not_overwritten(tmp_path: Path) -> None:
    config = SimulationConfig(tracks=2)
    measured = tmp_path / "measured"
    measured.mkdir()
    (measured / "tracks.csv").write_text("precious")
    for force in (False, True):
        with pytest.raises(ValueError, match="holds other files"):
            write_simulation(measured, config, force=force)
    assert contents(measured) == {"tracks.csv": b"precious"}
    with pytest.raises(ValueError, match="is a file"):
        write_simulation(measured / "tracks.csv", config)
    with pytest.raises(FileNotFoundError, match="existing folder"):
        write_simulation(tmp_path / "no" / "where", config)
    with pytest.raises(ValueError, match="'csv' or 'parquet'; got 'xls'"):
        write_simulation(tmp_path / "x", config, "xls")  # type: ignore[arg-type]


def test_force_replaces_a_simulated_dataset_and_leaves_nothing_stale(tmp_path: Path) -> None:
    write_simulation(tmp_path / "d", SimulationConfig(tracks=2), "parquet")
    with pytest.raises(ValueError, match="--force"):
        write_simulation(tmp_path / "d", SimulationConfig(tracks=3))
    write_simulation(tmp_path / "d", SimulationConfig(tracks=3), force=True)
    assert len(read_dataset(tmp_path / "d")) == 3
    assert not list((tmp_path / "d").glob("*.parquet"))


def test_a_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail(tracks: Iterable[SimulatedTrack], total: int, what: str) -> Iterator[SimulatedTrack]:
        yield next(iter(tracks))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_simulation(tmp_path / "d", SimulationConfig(tracks=2), watch=fail)
    assert list(tmp_path.iterdir()) == []


def test_no_spin_labels_on_request(tmp_path: Path) -> None:
    write_simulation(tmp_path / "d", SimulationConfig(tracks=2, spin_labels=False))
    dataset = read_dataset(tmp_path / "d")
    assert dataset.label_names == ["topspin", "sidespin", "speed"]
    assert dataset.info.spin_noise is None


def test_memory_does_not_grow_with_the_number_of_tracks() -> None:
    def peak(tracks: int) -> int:
        tracemalloc.start()
        for number, _ in enumerate(simulate(SimulationConfig(tracks=tracks, rate=25.0, block=8))):
            if number % 8 == 0:
                gc.collect()  # what nobody refers to any more is no growth, whenever Python would notice
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    peak(8)  # warms up caches
    few, many = (min(peak(tracks) for _ in range(2)) for tracks in (16, 48))  # of two: what is made once is no growth
    assert many < 1.3 * few
