"""`ballfg predict` as a user meets it: the table, the messages, the exit statuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pytest

from ballfg.cli.main import run
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import Dataset, read_dataset

METHODS = ("smoother", "online", "ekf", "sliding-window")
COLUMNS = ["trajectory", "t", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z"]
TEXT = pa_csv.ConvertOptions(column_types={"trajectory": "string"})


def status(*arguments: object) -> int:
    with pytest.raises(SystemExit) as exit_:
        run([str(argument) for argument in arguments])
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("cli") / "shots"
    write_simulation(folder, SimulationConfig(tracks=6, rate=60.0, seed=2))
    return read_dataset(folder)


@pytest.mark.parametrize("method", METHODS)
def test_one_row_for_each_stamp_after_the_observed_part(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    out = tmp_path / "predictions.csv"
    assert status("predict", dataset.path, "--method", method, "--observe", 0.3, "--out", out) == 0
    said = capsys.readouterr()
    notes = [line for line in said.err.splitlines() if not line.endswith("tracks predicted")]  # progress may show
    assert notes == []
    assert said.out.startswith(f"{out}: ")
    assert f"of 6 tracks, from the first 0.3 s of each by {method}" in said.out
    assert "  6 tracks: converged\n" in said.out
    assert "RMSE against what was measured there: " in said.out
    table = pa_csv.read_csv(out, convert_options=TEXT)
    assert table.column_names == COLUMNS
    values = np.stack([table[name].to_numpy() for name in COLUMNS[1:]], axis=1)
    later = [(t.name, t.times > t.times[0] + 0.3 + 1e-9, t) for t in dataset]
    assert table["trajectory"].to_pylist() == [name for name, mask, _ in later for _ in range(mask.sum())]
    np.testing.assert_array_equal(values[:, 0], np.concatenate([t.times[mask] for _, mask, t in later]))
    assert np.isfinite(values).all()
    assert (values[:, 4:] >= dataset.info.position_noise).all()
    errors = values[:, 1:4] - np.concatenate([t.positions[mask] for _, mask, t in later])
    assert (np.abs(errors) < 6 * values[:, 4:]).all()


def test_parquet_and_the_default_method(dataset: Dataset, tmp_path: Path) -> None:
    assert status("predict", dataset.path, "--observe", 0.3, "--method", "smoother", "--out", tmp_path / "p.csv") == 0
    assert status("predict", dataset.path, "--observe", 0.3, "--jobs", 1, "--out", tmp_path / "p.parquet") == 0
    assert pa_csv.read_csv(tmp_path / "p.csv", convert_options=TEXT).equals(pq.read_table(tmp_path / "p.parquet"))


def test_the_same_bytes_twice(dataset: Dataset, tmp_path: Path) -> None:
    for name in ("a", "b"):
        command = ["predict", dataset.path, "--observe", 0.3, "--method", "ekf", "--out", tmp_path / f"{name}.csv"]
        assert status(*command) == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_tracks_that_end_too_early_are_counted(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    duration = sorted(t.duration for t in dataset)[2]
    command = ["predict", dataset.path, "--method", "sliding-window", "--out", tmp_path / "p.csv", "--observe"]
    assert status(*command, duration) == 0
    assert "3 of the tracks end within" in capsys.readouterr().out
    assert status(*command, 60) == 0
    said = capsys.readouterr().out
    assert ": 0 positions of 6 tracks" in said
    assert "RMSE" not in said
    assert (tmp_path / "p.csv").read_text() == ",".join(COLUMNS) + "\n"


def test_what_went_wrong_is_said(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One sample tells no velocity: the status is not silent."""
    command = ["predict", dataset.path, "--method", "smoother", "--observe", 1e-3, "--out", tmp_path / "p.csv"]
    assert status(*command) == 0
    assert "  6 tracks: there are too few samples to tell a velocity" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("observe", "message"),
    [
        ("0", "observe must be a positive number of seconds; got 0"),
        ("-0.25", "observe must be a positive number of seconds; got -0.25"),
        ("nan", "observe must be a positive number of seconds; got nan"),
        ("soon", "'--observe'"),
    ],
)
def test_bad_observe(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], observe: str, message: str
) -> None:
    assert status("predict", dataset.path, "--observe", observe, "--out", tmp_path / "p.csv") == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert said.err.startswith("ballfg: error: ")
    assert message in said.err
    assert list(tmp_path.iterdir()) == []


def test_missing_observe(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status("predict", dataset.path, "--out", tmp_path / "p.csv") == 2
    assert "--observe" in capsys.readouterr().err
