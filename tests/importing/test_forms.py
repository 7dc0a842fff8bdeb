"""Simulated shots in many forms, each imported with no option but --out, against the shots themselves."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

import ballfg as bf
from ballfg.importing import Choices
from ballfg.importing.proposal import propose
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import Track, read_dataset
from tests.commands import refused, status
from tests.importing.throws import write_rows

TABLE = 0.76
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From a frame with z up to one with y up."""
Z_DOWN = np.diag([1.0, -1.0, -1.0])
X_DOWN = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
EPOCH = 1_763_800_000_123_456_789
"""ns, the stamp of the first sample of all."""
GAP = 2.5
"""s from the end of one shot to the start of the next."""


@pytest.fixture(scope="module")
def shots() -> list[Track]:
    return [one.track for one in simulate(SimulationConfig(6, rate=120.0, seed=3))]


def one_after_the_other(shots: Sequence[Track]) -> list[np.ndarray]:
    """The stamps (s) of shots that were recorded with pauses between them."""
    start, found = 0.0, []
    for shot in shots:
        found.append(start + shot.times)
        start = float(found[-1][-1]) + GAP
    return found


def csv_millimetres_y_up(folder: Path, shots: list[Track]) -> Path:
    path = folder / "capture.csv"
    rows = [
        (shot.name, 1e3 * t, *(1e3 * Y_UP @ p))
        for shot in shots
        for t, p in zip(shot.times, shot.positions, strict=True)
    ]
    write_rows(path, "Shot ID,Timestamp,pos_x,pos_y,pos_z", rows)
    return path


def semicolons_and_decimal_commas(folder: Path, shots: list[Track]) -> Path:
    path = folder / "messung.csv"
    rows = [
        [repr(float(v)).replace(".", ",") for v in (t, *(100.0 * p))]
        for shot, times in zip(shots, one_after_the_other(shots), strict=True)
        for t, p in zip(times, shot.positions, strict=True)
    ]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(["Zeit;X [cm];Y [cm];Z [cm]", *map(";".join, rows)]).encode())
    return path


def points_in_thousands(folder: Path, shots: list[Track]) -> Path:
    """Millimetres as a German spreadsheet shows them: 1.319,3152."""
    path, turned = folder / "tabelle.csv", str.maketrans(",.", ".,")
    rows = [
        [f"{v:,.{digits}f}".translate(turned) for v, digits in zip((t, *(1e3 * p)), (9, 4, 4, 4), strict=True)]
        for shot, times in zip(shots, one_after_the_other(shots), strict=True)
        for t, p in zip(times, shot.positions, strict=True)
    ]
    path.write_text("\n".join(["Zeit [s];X [mm];Y [mm];Z [mm]", *map(";".join, rows)]))
    return path


def commas_in_thousands(folder: Path, shots: list[Track]) -> Path:
    """Millimetres as an English spreadsheet shows them, 1,319.3152, with the minus sign of a typesetter."""
    path = folder / "table.csv"
    rows = [
        [f"{v:,.{digits}f}".replace("-", "\u2212") for v, digits in zip((t, *(1e3 * p)), (9, 4, 4, 4), strict=True)]
        for shot, times in zip(shots, one_after_the_other(shots), strict=True)
        for t, p in zip(times, shot.positions, strict=True)
    ]
    path.write_text("\n".join(["time [s];x [mm];y [mm];z [mm]", *map(";".join, rows)]), encoding="utf-8")
    return path


def tabs_with_a_row_of_units(folder: Path, shots: list[Track]) -> Path:
    path = folder / "export.tsv"
    rows = [(t, *(p / 0.0254), 0.4) for shot in shots for t, p in zip(shot.times, shot.positions, strict=True)]
    write_rows(
        path, "# made by a tracker\n# version 3\ntime\tball_x\tball_y\tball_z\terr\ns\tin\tin\tin\tpx", rows, "\t"
    )
    return path


def no_header_at_all(folder: Path, shots: list[Track]) -> Path:
    path = folder / "plain.txt"
    rows = [(i, t, *(1e3 * p)) for i, s in enumerate(shots) for t, p in zip(s.times, s.positions, strict=True)]
    write_rows(path, "", rows, " ")
    return path


def nested_json(folder: Path, shots: list[Track]) -> Path:
    path = folder / "shots.json"
    content = {
        "fps": 120,
        "shots": [
            {
                "id": shot.name,
                "group": "fast" if i % 2 else "slow",
                "samples": [
                    {"t_ms": 1e3 * t, "pos": (Y_UP @ p).tolist()}
                    for t, p in zip(shot.times.tolist(), shot.positions, strict=True)
                ],
            }
            for i, shot in enumerate(shots)
        ],
    }
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def json_lines_of_nanoseconds(folder: Path, shots: list[Track]) -> Path:
    path = folder / "stream.jsonl"
    lines = [
        json.dumps({"stamp": EPOCH + round(1e9 * t), "ball": {"x": p[0], "y": p[1], "z": p[2]}, "seen": True})
        for shot, times in zip(shots, one_after_the_other(shots), strict=True)
        for t, p in zip(times.tolist(), shot.positions.tolist(), strict=True)
    ]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def parquet_of_dates_and_feet(folder: Path, shots: list[Track]) -> Path:
    path = folder / "shots.parquet"
    origin = datetime(2026, 3, 1, 12, tzinfo=UTC)
    feet = np.concatenate([shot.positions for shot in shots]) / 0.3048
    stamps = [origin + timedelta(seconds=float(t)) for times in one_after_the_other(shots) for t in times]
    table = {"when (datetime)": stamps, "X": feet[:, 0], "Y": feet[:, 1], "Z": feet[:, 2]}
    pq.write_table(pa.table(table), path)
    return path


def excel_with_a_sheet_a_shot(folder: Path, shots: list[Track]) -> Path:
    path = folder / "shots.xlsx"
    book = openpyxl.Workbook()
    book.active.title = "notes"
    book.active.append(["recorded in spring"])
    for shot in shots:
        sheet = book.create_sheet(f"shot {shot.name}")
        sheet.append(["Time (ms)", "X (mm)", "Y (mm)", "Z (mm)"])
        for t, p in zip(shot.times.tolist(), shot.positions.tolist(), strict=True):
            sheet.append([1e3 * t, *(1e3 * v for v in p)])
    book.save(path)
    return path


def hdf5_with_z_down(folder: Path, shots: list[Track]) -> Path:
    path = folder / "log.h5"
    with h5py.File(path, "w") as file:
        for shot in shots:
            group = file.create_group(f"recordings/{shot.name}")
            group["time_stamp"] = (1e6 * shot.times).round().astype(np.int64)
            group["ball_position"] = shot.positions @ Z_DOWN.T
    return path


def npz_in_microseconds(folder: Path, shots: list[Track]) -> Path:
    path = folder / "shots.npz"
    np.savez(
        path,
        traj=np.concatenate([[int(shot.name)] * len(shot) for shot in shots]),
        t=np.concatenate([1e6 * shot.times for shot in shots]),
        xyz=np.concatenate([1e3 * shot.positions for shot in shots]),
    )
    return path


def matlab_structures(folder: Path, shots: list[Track]) -> Path:
    path = folder / "shots.mat"
    structures = [{"time": shot.times, "pos": shot.positions @ X_DOWN.T, "speed": 7.0} for shot in shots]
    scipy.io.savemat(path, {"shots": np.array(structures, dtype=object)})
    return path


def matlab_7_3(folder: Path, shots: list[Track]) -> Path:
    path = folder / "shots73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for shot in shots:
            group = file.create_group(f"shot_{shot.name}")
            group["t"] = shot.times[None]
            group["pos"] = shot.positions.T
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def a_folder_with_one_file_a_shot(folder: Path, shots: list[Track]) -> Path:
    path = folder / "recordings"
    path.mkdir()
    (path / "README.txt").write_text("each file is a shot\n", encoding="utf-8")
    for shot in shots:
        rows = [(t, *(1e3 * Y_UP @ p)) for t, p in zip(shot.times, shot.positions, strict=True)]
        write_rows(path / f"shot_{shot.name}.csv", "t,x,y,z", rows)
    return path


def an_mcap_bag(folder: Path, shots: list[Track]) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    path = folder / "bag"
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "geometry_msgs/msg/PointStamped"
    point, stamped = store.types["geometry_msgs/msg/Point"], store.types[kind]
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/ball", kind, typestore=store)
        for shot, times in zip(shots, one_after_the_other(shots), strict=True):
            for t, p in zip(times, shot.positions, strict=True):
                ns = EPOCH + round(1e9 * float(t))
                stamp = time(sec=ns // 10**9, nanosec=ns % 10**9)
                message = stamped(header=header(stamp=stamp, frame_id="world"), point=point(x=p[0], y=p[1], z=p[2]))
                writer.write(connection, ns, store.serialize_cdr(message, kind))
    return path


def headers_of_three_lines(folder: Path, shots: list[Track]) -> Path:
    path = folder / "pose3d.csv"
    names = ["scorer" + ",net" * 4, "bodyparts" + ",ball" * 4, "coords,x,y,z,likelihood"]
    rows = [
        (round(120.0 * t), *(1e3 * p), 0.99)
        for shot, times in zip(shots, one_after_the_other(shots), strict=True)
        for t, p in zip(times, shot.positions, strict=True)
    ]
    write_rows(path, "\n".join(names), rows)
    return path


Form = Callable[[Path, list[Track]], Path]
FORMS: tuple[Form, ...] = (
    csv_millimetres_y_up, semicolons_and_decimal_commas, points_in_thousands, commas_in_thousands,
    tabs_with_a_row_of_units, no_header_at_all, nested_json, json_lines_of_nanoseconds, parquet_of_dates_and_feet,
    excel_with_a_sheet_a_shot, hdf5_with_z_down, npz_in_microseconds, matlab_structures, matlab_7_3,
    a_folder_with_one_file_a_shot, an_mcap_bag,
)  # fmt: skip


def same_shots(found: Sequence[Track], shots: Sequence[Track], stamps: float = 1e-9) -> None:
    """The shots are there, turned together about the vertical by some angle, and not mirrored."""
    assert len(found) == len(shots)
    for one, shot in zip(found, shots, strict=True):
        np.testing.assert_allclose(one.times - one.times[0], shot.times - shot.times[0], rtol=0.0, atol=stamps)
        np.testing.assert_allclose(one.positions[:, 2], shot.positions[:, 2], rtol=0.0, atol=1e-6)
    ours, theirs = (np.concatenate([t.positions[:, :2] for t in tracks]) for tracks in (found, shots))
    turn = np.linalg.lstsq(theirs, ours, rcond=None)[0]
    np.testing.assert_allclose(theirs @ turn, ours, atol=1e-6)
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.__name__)
def test_no_option_but_out(form: Form, shots: list[Track], tmp_path: Path) -> None:
    source = form(tmp_path, shots)
    out = tmp_path / "imported"
    assert status("import", source, "--out", out) == 0
    data = read_dataset(out)
    same_shots(list(data), shots, 1e-6)
    assert data.table == pytest.approx(TABLE, abs=0.01)
    assert not any("ignored" in note for note in data.notes)
    page = (out / "import.html").read_text(encoding="utf-8")
    assert "<svg" in page
    assert "--table-height" in page


def test_frames_and_a_rate(shots: list[Track], tmp_path: Path) -> None:
    source = headers_of_three_lines(tmp_path, shots)
    assert "fits about 120 Hz. Decide it with --rate 120." in refused("import", source, "--out", tmp_path / "out")
    assert status("import", source, "--out", tmp_path / "out", "--rate", 120) == 0
    same_shots(list(read_dataset(tmp_path / "out")), shots, 2e-9)


def test_labels_are_kept(shots: list[Track], tmp_path: Path) -> None:
    data = bf.import_tracks(nested_json(tmp_path, shots), out=tmp_path / "out", file_format="parquet")
    assert [track.labels["group"] for track in data] == ["slow", "fast"] * 3
    assert data.names == [shot.name for shot in shots]
    assert (tmp_path / "out" / "tracks.parquet").is_file()
    assert data.info.imported is not None
    assert data.info.imported["up axis"].startswith("y (sure")


def test_data_in_memory_go_into_an_estimate(shots: list[Track]) -> None:
    data = bf.import_tracks([np.column_stack([1e3 * shot.times, 1e3 * shot.positions]) for shot in shots])
    same_shots(list(data), shots)
    estimates = bf.estimate(data)
    assert len(estimates) == 6
    frame = {"t": shots[0].times, "pos": shots[0].positions}
    one = bf.import_tracks(frame, table_height=TABLE)
    np.testing.assert_array_equal(one["000"].positions, shots[0].positions)
    assert one["000"].dataset.table == TABLE


def test_data_frames(shots: list[Track]) -> None:
    pandas = pytest.importorskip("pandas")
    rows = [(s.name, t, *(100 * p)) for s in shots for t, p in zip(s.times, s.positions, strict=True)]
    data = bf.import_tracks(pandas.DataFrame(rows, columns=["rally", "sec", "x", "y", "z"]))
    same_shots(list(data), shots)


def test_the_same_bytes_again(shots: list[Track], tmp_path: Path) -> None:
    source = csv_millimetres_y_up(tmp_path, shots)
    for name in ("one", "two"):
        assert status("import", source, "--out", tmp_path / name, "--name", "shots") == 0
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes()


def test_cells_that_are_no_numbers_are_told_of_columns_that_are_used(shots: list[Track], tmp_path: Path) -> None:
    rows = [
        [shot.name, t, *p, 0.5] for shot in shots[:2] for t, p in zip(shot.times, shot.positions.tolist(), strict=True)
    ]
    rows[5][4], rows[7][4], rows[9][5] = "blurred", "hidden", "warm"
    write_rows(tmp_path / "shots.csv", "shot,t,x,y,z,temperature", rows)
    notes = " ".join(propose(tmp_path / "shots.csv", Choices(table_height=TABLE)).notes)
    assert "column 'z': 2 cells such as 'blurred' count as missing" in notes
    assert "'temperature'" not in notes  # whose cells nobody needs


def test_null_in_a_json_file_is_a_missing_sample(shots: list[Track], tmp_path: Path) -> None:
    """Arrays side by side, as loggers write them; one coordinate of the fourth sample was not there."""
    shot = shots[0]
    columns = {"t": shot.times.tolist()} | {axis: shot.positions[:, i].tolist() for i, axis in enumerate("xyz")}
    columns["y"][3] = None
    (tmp_path / "shot.json").write_text(json.dumps(columns))
    (track,) = bf.import_tracks(tmp_path / "shot.json", table_height=TABLE)
    np.testing.assert_allclose(track.positions, np.delete(shot.positions, 3, axis=0), atol=1e-6)


def test_a_unit_that_one_of_the_named_columns_has_is_that_of_all(shots: list[Track], tmp_path: Path) -> None:
    rows = [
        (shot.name, t, *p) for shot in shots for t, p in zip(shot.times, (1e3 * shot.positions).tolist(), strict=True)
    ]
    write_rows(tmp_path / "a.csv", "shot,t,left_x,left_y_mm,left_z_mm", rows)
    named = {"x": "left_x", "y": "left_y_mm", "z": "left_z_mm"}
    imported = propose(tmp_path / "a.csv", Choices(table_height=TABLE, columns=named)).info.imported
    assert imported["unit of length"] == "mm (sure: named in the source, and the fall agrees)"
