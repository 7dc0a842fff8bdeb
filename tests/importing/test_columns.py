"""Columns of all kinds: standard deviations, times of day, stamps in two parts, headers in comments, ragged lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import ballfg as bf
from ballfg.importing import Choices
from ballfg.importing.choices import UndecidedError
from ballfg.importing.importer import _drawing
from ballfg.importing.proposal import propose
from ballfg.tracks import Track
from tests.importing.throws import thrown, write_rows


def test_sigmas_turn_with_the_axes_and_have_the_unit_of_the_positions(tmp_path: Path) -> None:
    t, p = thrown()
    sigmas = np.full_like(p, 2.0)  # mm
    sigmas[:, 1], sigmas[:, 2] = 3.0, np.linspace(4.0, 5.0, len(t))
    seen = 1e3 * p @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # x, up, -y
    path = write_rows(
        tmp_path / "a.csv", "t,x,y,z,sigma_x,sigma_y,sigma_z", np.column_stack((t, seen, sigmas)).tolist()
    )
    proposal = propose(path, Choices())
    (track,) = proposal.tracks
    np.testing.assert_allclose(track.positions, p, atol=1e-9)
    np.testing.assert_allclose(track.sigmas, 1e-3 * sigmas[:, [0, 2, 1]], atol=1e-12)
    assert proposal.info.imported["column sigmas"].startswith("sigma_x, sigma_y, sigma_z (sure")


@pytest.mark.parametrize(
    ("places", "sigma", "size", "sigma_size"),
    [("[m]", "[mm]", 1.0, 1e-3), ("[mm]", "", 1e-3, 1e-3), ("[cm]", "[cm]", 0.01, 0.01), ("", "[mm]", 1.0, 1e-3)],
)
def test_sigmas_have_the_unit_of_their_own_names(
    places: str, sigma: str, size: float, sigma_size: float, tmp_path: Path
) -> None:
    """Where the names state none, they have that of the positions."""
    t, p = thrown()
    names = ["t", *(f"{axis} {places}" for axis in "xyz"), *(f"sigma_{axis} {sigma}" for axis in "xyz")]
    rows = np.column_stack((t, p / size, np.full_like(p, 0.5))).tolist()
    (track,) = propose(write_rows(tmp_path / "a.csv", ",".join(names), rows), Choices()).tracks
    np.testing.assert_allclose(track.positions, p, atol=1e-9)
    np.testing.assert_allclose(track.sigmas, np.full_like(p, 0.5 * sigma_size), rtol=1e-12)


@pytest.mark.parametrize("flip", [None, "x", "y", "z"])
def test_a_spin_label_turns_with_the_axes(flip: str | None) -> None:
    """The Magnus force, spin x velocity, is the same force before and after the turn, in a mirrored frame too."""
    t, p = thrown()
    spin = np.array([10.0, -200.0, 30.0])  # in the frame with z up
    force = np.cross(spin, [5.0, 0.3, 1.0])
    seen = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # x, up, -y
    if flip is not None:
        seen["xyz".index(flip)] *= -1.0
    there = np.linalg.det(seen) * seen @ spin
    np.testing.assert_allclose(np.cross(there, seen @ [5.0, 0.3, 1.0]), seen @ force, atol=1e-12)
    columns = dict(zip(("t", "x", "y", "z"), np.column_stack((t, p @ seen.T)).T, strict=True))
    labels = {f"spin_{axis}": np.full(len(t), value) for axis, value in zip("xyz", there, strict=True)}
    (track,) = bf.import_tracks({**columns, **labels}, flip=flip)
    np.testing.assert_allclose(track.positions, p, atol=1e-12)
    np.testing.assert_allclose(track.spin_label, spin, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "turns"),
    [("spin_{} [rpm]", 60.0), ("spin_{}_rpm", 60.0), ("Spin {} (rev/s)", 1.0), ("spin_{}_rev_per_s", 1.0),
     ("w{} [deg/s]", 360.0), ("omega_{}_rad_s", 2.0 * np.pi), ("spin_{}", 2.0 * np.pi)],
)  # fmt: skip
def test_a_spin_label_has_the_unit_of_its_name(name: str, turns: float, tmp_path: Path) -> None:
    """A turn in a second, in each unit; with y up."""
    t, p = thrown()
    spin = np.array([3.0, -20.0, 7.0])  # turns in a second, in the frame with z up
    seen = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # x, up, -y
    names = ["t", "x", "y", "z", *(name.format(axis) for axis in "xyz")]
    rows = np.column_stack((t, p @ seen.T, np.tile(turns * seen @ spin, (len(t), 1)))).tolist()
    proposal = propose(write_rows(tmp_path / "a.csv", ",".join(names), rows), Choices())
    (track,) = proposal.tracks
    np.testing.assert_allclose(track.spin_label, 2.0 * np.pi * spin, rtol=1e-9)
    assert any("rad/s from" in note for note in proposal.notes) == (name != "spin_{}")


@pytest.mark.parametrize("names", [("wx", "wy", "wz"), ("spin_x [rpm]", "spin_y [rpm]", "spin_z")])
def test_spins_without_a_unit_stay_labels_and_that_is_said(names: tuple[str, ...], tmp_path: Path) -> None:
    t, p = thrown()
    rows = np.column_stack((t, p, np.tile([1.0, 2.0, 3.0], (len(t), 1)))).tolist()
    proposal = propose(write_rows(tmp_path / "a.csv", ",".join(("t", "x", "y", "z", *names)), rows), Choices())
    assert proposal.tracks[0].spin_label is None
    said = f"{', '.join(names)} stay labels: a spin needs spin_x, spin_y and spin_z in rad/s"
    assert any(note.startswith(said) for note in proposal.notes)


@pytest.mark.parametrize(
    ("name", "yes", "no"), [("valid", "1", "0"), ("Ball_Visible", "True", "False"), ("is tracked", "1.0", "0.0")]
)
def test_rows_where_a_column_says_that_the_ball_was_not_seen_are_missing(
    name: str, yes: str, no: str, tmp_path: Path
) -> None:
    """A tracker that lost the ball repeats the last position, and says so."""
    t, p = thrown()
    seen = np.arange(len(t)) % 20 < 15
    held = p[np.maximum.accumulate(np.where(seen, np.arange(len(t)), 0))]
    rows = [[*row, yes if one else no] for row, one in zip(np.column_stack((t, held)).tolist(), seen, strict=True)]
    proposal = propose(write_rows(tmp_path / "a.csv", f"t,x,y,z,{name}", rows), Choices())
    np.testing.assert_allclose(proposal.tracks[0].times, t[seen], atol=1e-12)
    np.testing.assert_allclose(proposal.tracks[0].positions, p[seen], atol=1e-12)
    assert f"{(~seen).sum()} rows whose own column says that the ball was not seen left out" in proposal.notes


@pytest.mark.parametrize("bad", ["0", "-2", "", "1e16"])
def test_a_sample_whose_sigma_is_none_is_missing(tmp_path: Path, bad: str) -> None:
    t, p = thrown()
    rows = np.column_stack((t, p, np.full_like(p, 0.002))).tolist()
    rows[7][5] = bad
    proposal = propose(write_rows(tmp_path / "a.csv", "t,x,y,z,sigma_x,sigma_y,sigma_z", rows), Choices())
    np.testing.assert_allclose(proposal.tracks[0].times, np.delete(t, 7), atol=1e-12)
    assert "1 row without a time or a position left out" in proposal.notes


@pytest.mark.parametrize(("separator", "sign"), [(",", "."), (";", "."), (";", ","), ("\t", "."), ("|", ",")])
def test_times_of_day_count_from_midnight(tmp_path: Path, separator: str, sign: str) -> None:
    t, p = thrown()
    clock = [f"12:59:{59.5 + s:06.3f}" if s < 0.495 else f"13:00:{abs(s - 0.5):06.3f}" for s in t]
    rows = [
        [str(cell).replace(".", sign) for cell in (stamp, *point)]
        for stamp, point in zip(clock, p.tolist(), strict=True)
    ]
    (track,) = bf.import_tracks(write_rows(tmp_path / "a.csv", separator.join(("time", *"xyz")), rows, separator))
    np.testing.assert_allclose(track.times, 13 * 3600 - 0.5 + t, atol=1e-9)


@pytest.mark.parametrize(("separator", "sign"), [(",", "."), (";", ","), ("\t", ",")])
def test_more_text_than_numbers(tmp_path: Path, separator: str, sign: str) -> None:
    """Dates, words and empty cells beside four numbers: none of them hides what separates the cells."""
    t, p = thrown()
    rows = []
    for k, row in enumerate(np.column_stack((t, p)).tolist()):
        numbers = [str(cell).replace(".", sign) for cell in row]
        rows.append(["2026-03-01", "court 1", f"seen by {k % 3}", *numbers, "", ""])
    header = separator.join(("day", "where", "note", "t", "x", "y", "z", "remark", "by hand"))
    (track,) = bf.import_tracks(write_rows(tmp_path / "a.csv", header, rows, separator))
    np.testing.assert_allclose(track.positions, p, atol=1e-9)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("header", ["t{0}x{0}y{0}z", ""])
def test_units_in_the_cells(tmp_path: Path, separator: str, header: str) -> None:
    t, p = thrown()
    values = np.column_stack((1e3 * t, p)).tolist()
    rows = [[f"{v:.9g} {unit}" for v, unit in zip(row, ("ms", "m", "m", "m"), strict=True)] for row in values]
    (track,) = propose(write_rows(tmp_path / "a.csv", header.format(separator), rows, separator), Choices()).tracks
    np.testing.assert_allclose(track.positions, p, atol=1e-7)
    np.testing.assert_allclose(track.times, t, atol=1e-9)


def test_stamps_in_seconds_and_nanoseconds(tmp_path: Path) -> None:
    t, p = thrown()
    ns = np.round(1e9 * t).astype(np.int64) + 1_763_800_000_700_000_000
    rows = [(n // 10**9, n % 10**9, *q) for n, q in zip(ns.tolist(), p.tolist(), strict=True)]
    path = write_rows(tmp_path / "a.csv", "header.stamp.sec,header.stamp.nanosec,x,y,z", rows)
    np.testing.assert_allclose(bf.import_tracks(path)["000"].times, t, atol=1e-9)


@pytest.mark.parametrize("header", ["# z y x t", "% z,y,x,t", "// z;y;x;t"])
def test_a_header_in_a_comment(tmp_path: Path, header: str) -> None:
    t, p = thrown()
    rows = np.column_stack((p[:, ::-1], t)).tolist()
    lines = [header[-2].join(map(str, row)) for row in rows]
    (tmp_path / "a.txt").write_text("\n".join(["# made by a tracker", header, *lines]), encoding="utf-8")
    proposal = propose(tmp_path / "a.txt", Choices())
    np.testing.assert_allclose(proposal.tracks[0].positions, p, atol=1e-9)
    assert proposal.info.imported["column x, y, z"] == "x, y, z (sure: names)"


def test_lines_of_another_width_are_left_out_and_counted(tmp_path: Path) -> None:
    t, p = thrown()
    lines = [",".join(map(str, row)) for row in np.column_stack((t, p)).tolist()]
    lines[20:20] = ["lost the ball", "1.0,2.0"]
    (tmp_path / "a.csv").write_text("\n".join(["t,x,y,z", *lines]), encoding="utf-8")
    proposal = propose(tmp_path / "a.csv", Choices())
    assert len(proposal.tracks[0]) == len(t)
    assert "2 lines without 4 cells left out" in proposal.notes


def test_whole_numbers_and_names_of_a_parquet_file(tmp_path: Path) -> None:
    t, p = thrown()
    frames = np.arange(len(t))
    columns = {
        "frame": np.tile(frames, 2),
        "shot": ["a"] * len(t) + ["b"] * len(t),
        **{axis: np.tile(1e3 * p[:, i], 2) for i, axis in enumerate("xyz")},
    }
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    data = bf.import_tracks(tmp_path / "a.parquet", rate=100.0)
    assert data.names == ["a", "b"]
    for track in data:
        np.testing.assert_allclose(track.times, t, atol=1e-12)
        np.testing.assert_allclose(track.positions, p, atol=1e-9)


def test_a_point_beside_columns_is_no_column() -> None:
    t, p = thrown()
    columns = {axis: p[:, i].tolist() for i, axis in enumerate("xyz")}
    (track,) = bf.import_tracks({"t": t.tolist(), "ball": columns, "camera": {"x": 1.0, "y": -4.0, "z": 2.0}})
    np.testing.assert_allclose(track.positions, p, atol=1e-12)


def test_a_column_is_named_in_any_case_and_without_its_unit(tmp_path: Path) -> None:
    t, p = thrown()
    rows = np.column_stack((t, p, p + 9.0)).tolist()
    path = write_rows(tmp_path / "a.csv", "T [s],Left_X,Left_Y,Left_Z,x,y,z", rows)
    chosen = {"t": "T", "x": "left_x", "y": "left_y", "z": "LEFT_Z"}
    np.testing.assert_allclose(propose(path, Choices(columns=chosen)).tracks[0].positions, p, atol=1e-9)
    with pytest.raises(ValueError, match="has no 'left' but"):
        propose(path, Choices(columns=chosen | {"x": "left"}))


def test_a_rate_beside_times_is_refused_and_beside_frames_taken(tmp_path: Path) -> None:
    t, p = thrown()
    rows = np.column_stack((2.0 * np.arange(len(t)), t, p)).tolist()
    path = write_rows(tmp_path / "a.csv", "frame,t,x,y,z", rows)
    with pytest.raises(ValueError, match=r"--rate is for sources without times; .* has them in t, and got 200"):
        propose(path, Choices(rate=200.0))
    (track,) = propose(path, Choices({"frame": "frame"}, rate=200.0)).tracks
    np.testing.assert_allclose(track.times, t, atol=1e-12)


def test_a_time_that_is_not_read_is_named(tmp_path: Path) -> None:
    """Not asked for a rate: frames may be missing, and the times would tell."""
    t, p = thrown()
    rows = [(f"03/31/2026 05:05:{5.0 + one:09.6f} PM", *row) for one, row in zip(t, p.tolist(), strict=True)]
    path = write_rows(tmp_path / "a.csv", "time,x,y,z", rows)
    with pytest.raises(UndecidedError, match=r"column of times, 'time', must hold numbers or dates, .* '03/31/2026"):
        propose(path, Choices())
    assert len(propose(path, Choices(rate=100.0)).tracks) == 1


def test_two_clocks_that_tell_different_times_are_asked_about(tmp_path: Path) -> None:
    t, p = thrown()
    header = "host_time,camera_time,x,y,z"
    path = write_rows(tmp_path / "a.csv", header, np.column_stack((t + 5.0, 1e3 * t, p)).tolist())
    (track,) = propose(path, Choices()).tracks  # one clock, in s and in ms with another origin
    np.testing.assert_allclose(np.diff(track.times), np.diff(t), atol=1e-9)
    own = t + 0.003 * np.sin(9.0 * t)
    path = write_rows(tmp_path / "b.csv", header, np.column_stack((own, 1e3 * t, p)).tolist())
    with pytest.raises(UndecidedError, match="host_time and camera_time may both be the time"):
        propose(path, Choices())


def test_shots_of_one_sample_and_late_samples_are_counted(tmp_path: Path) -> None:
    t, p = thrown()
    rows = [("a", *row) for row in np.column_stack((t, p)).tolist()]
    rows[30], rows[31] = rows[31], rows[30]
    rows += [("b", *rows[0][1:])]
    proposal = propose(write_rows(tmp_path / "a.csv", "shot,t,x,y,z", rows), Choices())
    (track,) = proposal.tracks
    np.testing.assert_allclose(track.positions, p, atol=1e-9)
    assert "1 row put in the order of their times" in proposal.notes
    assert "1 shot of fewer than two samples left out" in proposal.notes


def test_the_drawing_of_a_long_shot_has_few_points() -> None:
    t, p = np.arange(3000) / 1000.0, np.zeros((3000, 3))
    p[:, 0], p[:, 2] = t, 1.0 + np.sin(3.0 * t)
    counts = [str(_drawing([Track(t[::step], p[::step])], 0.76)).count("<use") for step in (1, 20)]
    assert counts[0] < 2.5 * counts[1]  # of 3,000 samples no more than 300 are drawn, of 150 each one
