"""`ballfg estimate` as a user meets it: the table, the messages, the exit statuses."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pytest

from ballfg.estimation.configure import FEW_TRACKS
from ballfg.estimation.registry import ESTIMATORS
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import read_dataset
from tests.commands import printed, refused, status

METHODS = ("smoother", "online", "ekf", "sliding-window")
STATE = ["x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz"]
COLUMNS = ["trajectory", "t", *STATE, *(f"sigma_{name}" for name in STATE)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "four shots"
    write_simulation(folder, SimulationConfig(tracks=4, rate=60.0, seed=2))
    return folder


@pytest.fixture
def damaged(dataset: Path, tmp_path: Path) -> Path:
    """A copy for a test to damage."""
    return Path(shutil.copytree(dataset, tmp_path / "damaged"))


# --- the table ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_one_row_of_finite_numbers_for_each_stamp(dataset: Path, tmp_path: Path, method: str) -> None:
    out = tmp_path / "states.csv"
    said = printed("estimate", dataset, "--method", method, "--out", out)
    notes = [line for line in said.err.splitlines() if not line.endswith("tracks estimated")]  # progress may show
    assert notes == []
    assert said.out.splitlines()[0] == f"doubt: {FEW_TRACKS}"
    assert said.out.splitlines()[1].startswith(f"{out}: ")
    assert f"states of 4 tracks by {method}" in said.out
    assert "  4 tracks: converged\n" in said.out
    table = pa_csv.read_csv(out, convert_options=pa_csv.ConvertOptions(column_types={"trajectory": "string"}))
    assert table.column_names == [*COLUMNS, "label"]
    values = np.stack([table[name].to_numpy() for name in COLUMNS[1:]], axis=1)
    assert np.isfinite(values).all()
    assert (values[:, 10:] > 0).all()
    tracks = list(read_dataset(dataset))
    assert table["trajectory"].to_pylist() == [t.name for t in tracks for _ in t.times]
    np.testing.assert_array_equal(values[:, 0], np.concatenate([t.times for t in tracks]))
    assert np.abs(values[:, 1:4] - np.concatenate([t.positions for t in tracks])).max() < 0.03
    assert sorted(p.name for p in tmp_path.iterdir()) == ["states.csv"]


def test_parquet_holds_the_same_and_the_smoother_is_the_default(dataset: Path, tmp_path: Path) -> None:
    assert status("estimate", dataset, "--method", "smoother", "--out", tmp_path / "states.csv") == 0
    assert status("estimate", dataset, "--out", tmp_path / "states.parquet") == 0
    read = pa_csv.read_csv(
        tmp_path / "states.csv", convert_options=pa_csv.ConvertOptions(column_types={"trajectory": "string"})
    )
    assert read.equals(pq.read_table(tmp_path / "states.parquet"))


@pytest.mark.parametrize("method", ["smoother", "online"])
def test_gtsam_gives_the_same_table(dataset: Path, tmp_path: Path, method: str) -> None:
    tables = []
    for solver in ("ballfg", "gtsam"):
        out = tmp_path / f"{solver}.csv"
        assert status("estimate", dataset, "--method", method, "--solver", solver, "--out", out, "--jobs", 1) == 0
        table = pa_csv.read_csv(out)
        tables.append(np.stack([table[name].to_numpy() for name in COLUMNS[2:]], axis=1))
    own, other = tables
    assert not np.array_equal(own, other)
    assert (np.abs(own - other)[:, :9] / own[:, 9:]).max() < 1e-3
    np.testing.assert_allclose(other[:, 9:], own[:, 9:], rtol=1e-3)


def test_the_same_bytes_on_one_process_or_two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ballfg.estimation.batch.START_UP", 0.0)  # a second process, however little work there is
    folder = tmp_path / "many"
    write_simulation(folder, SimulationConfig(tracks=70, rate=30.0, seed=3))  # more than a block of predictions
    for command in (["estimate", folder], ["predict", folder, "--observe", 0.3]):
        for name, jobs in (("one", 1), ("two", 2)):
            options = ["--method", "sliding-window", "--jobs", jobs, "--out", tmp_path / f"{name}.csv"]
            assert status(*command, *options) == 0
        assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_repaired_input_is_noted_on_stderr_and_exact_repeats_count_once(damaged: Path, tmp_path: Path) -> None:
    header, *rows = (damaged / "tracks.csv").read_text().splitlines()
    more = [f"{header},remark", *(f"{row},fine" for row in [*rows, rows[0]])]
    (damaged / "tracks.csv").write_text("\n".join(more) + "\n")
    said = printed("estimate", damaged, "--method", "sliding-window", "--out", tmp_path / "s.csv")
    assert all(line.startswith("note: ") for line in said.err.splitlines())
    assert "column 'remark' ignored" in said.err
    assert "note:" not in said.out
    assert len((tmp_path / "s.csv").read_text().splitlines()) == 1 + len(rows)


def test_from_any_folder_with_relative_paths(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(dataset, tmp_path / "my shots")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    options = ("--method", "sliding-window", "--model", "../my shots/model.yaml", "--out", "my states.csv")
    assert "\nmy states.csv: " in printed("estimate", "../my shots", *options).out
    assert (tmp_path / "elsewhere" / "my states.csv").is_file()


def test_an_older_result_is_replaced(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "states.csv"
    out.write_text("old")
    assert status("estimate", dataset, "--method", "sliding-window", "--out", out) == 0
    assert out.read_text().startswith("trajectory,t,x,y,z,")


# --- bad input ---------------------------------------------------------------------------------------------------


def assert_refused(out: Path, message: str, *arguments: object, command: str = "estimate") -> None:
    """Neither a table nor half of one is written."""
    before = sorted(out.parent.iterdir()) if out.parent.is_dir() else []
    assert message in refused(command, *arguments, "--out", out)
    assert (sorted(out.parent.iterdir()) if out.parent.is_dir() else []) == before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("trajectory,t,x,y,z", "trajectory,t,x,y,height", "z"),
        ("trajectory,t,x,y,z", "trajectory,t,x,y", "tracks.csv"),
        (None, "", "tracks.csv"),
    ],
)
def test_bad_columns(damaged: Path, tmp_path: Path, old: str | None, new: str, message: str) -> None:
    text = (damaged / "tracks.csv").read_text()
    (damaged / "tracks.csv").write_text(new if old is None else text.replace(old, new, 1))
    assert_refused(tmp_path / "s.csv", message, damaged)


@pytest.mark.parametrize("cell", ["nan", "inf", "soon", ""])
def test_bad_cells(damaged: Path, tmp_path: Path, cell: str) -> None:
    lines = (damaged / "tracks.csv").read_text().splitlines()
    lines[5] = ",".join([*lines[5].split(",")[:-1], cell])
    (damaged / "tracks.csv").write_text("\n".join(lines) + "\n")
    assert_refused(tmp_path / "s.csv", "tracks.csv", damaged)


@pytest.mark.parametrize(
    "text", ["flight: {drag: {k: fast}}", "flight: {lift: {k: 1}}", "flight: [", "flight: {drag: {k: -3}}", "{}: 1"]
)
def test_bad_model_files(dataset: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "model.yaml").write_text(text)
    assert_refused(tmp_path / "s.csv", "model.yaml", dataset, "--model", tmp_path / "model.yaml")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "kalman"], "method must be one of smoother, online, ekf, sliding-window; got 'kalman'"),
        (["--solver", "isam2"], "'--solver': 'isam2' is not one of 'ballfg', 'gtsam'"),
        (["--solver", "gtsam", "--method", "ekf"], "settings.solver must be 'ballfg' or None for the estimator 'ekf'"),
        (["--jobs", "0"], "'--jobs'"),
        (["--model", "none.yaml"], "none.yaml does not exist"),
        (["--bogus"], "--bogus"),
    ],
)
def test_bad_options(dataset: Path, tmp_path: Path, options: list[str], message: str) -> None:
    assert_refused(tmp_path / "s.csv", message, dataset, *options)


def test_bad_paths(dataset: Path, damaged: Path, tmp_path: Path) -> None:
    assert_refused(tmp_path / "s.csv", "none does not. Give the folder", tmp_path / "none")
    assert_refused(tmp_path / "s.csv", "is a file", dataset / "tracks.csv")
    assert_refused(tmp_path / "s.xlsx", "must end in .csv or .parquet", dataset)
    assert_refused(tmp_path / "none" / "s.csv", "is none. Create it first", dataset)
    (tmp_path / "folder.csv").mkdir()
    assert_refused(tmp_path / "folder.csv", "is a folder", dataset)
    (damaged / "dataset.yaml").unlink()
    assert_refused(tmp_path / "s.csv", "must hold dataset.yaml", damaged)


@pytest.mark.parametrize("name", ["tracks.csv", "tracks.parquet", "labels.csv", "truth.csv"])
@pytest.mark.parametrize("command", [("estimate",), ("predict", "--observe", "0.2")])
def test_the_measurements_are_not_replaced(damaged: Path, name: str, command: tuple[str, ...]) -> None:
    before = {p.name: p.read_bytes() for p in damaged.iterdir()}
    message = "out must not be a table of the dataset itself"
    assert_refused(damaged / name, message, damaged, *command[1:], command=command[0])
    assert {p.name: p.read_bytes() for p in damaged.iterdir()} == before


@pytest.mark.parametrize("command", [("estimate",), ("predict", "--observe", "0.2")])
def test_nor_through_a_link_nor_readings_nor_those_of_another_dataset(
    damaged: Path, dataset: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    other = shutil.copytree(dataset, tmp_path / "other")
    (tmp_path / "out.csv").symlink_to(damaged / "tracks.csv")
    (other / "speeds.csv").write_text("trajectory,t,speed,sigma\n")
    before = {p: p.read_bytes() for folder in (damaged, other) for p in folder.iterdir()}
    of_others = "out must not be a table of a dataset; got"
    for out, message in (
        (tmp_path / "out.csv", "out must not be a table of the dataset itself; got"),
        (damaged / "spins.csv", "out must not be a table of the dataset itself; got"),
        (other / "tracks.csv", of_others),
        (other / "speeds.csv", of_others),
    ):
        assert_refused(out, message, damaged, *command[1:], command=command[0])
    assert {p: p.read_bytes() for folder in (damaged, other) for p in folder.iterdir()} == before


def test_missing_option(dataset: Path) -> None:
    assert "--out" in refused("estimate", dataset)


@pytest.mark.parametrize("command", ["estimate", "predict"])
def test_ctrl_c_leaves_nothing(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    def interrupt(items: object, *_: object) -> object:
        yield next(iter(items))  # type: ignore[call-overload]
        raise KeyboardInterrupt

    monkeypatch.setattr(f"ballfg.cli.commands.{command}.progress", interrupt)
    options = ["--observe", "0.2"] if command == "predict" else []
    assert (
        "interrupted"
        in printed(
            command, dataset, "--method", "sliding-window", *options, "--out", tmp_path / "s.csv", status=130
        ).err
    )
    assert list(tmp_path.iterdir()) == []


# --- help, start ---------------------------------------------------------------------------------------


def test_help_names_the_estimators() -> None:
    """The option names them without importing them, so that --help stays quick."""
    shown = printed("estimate", "--help").out
    assert all(name in shown for name in ESTIMATORS)
