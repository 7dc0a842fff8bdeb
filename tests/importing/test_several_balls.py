"""Recordings of several balls, of one coordinate, and of motion capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ballfg as bf
from ballfg.importing.choices import UndecidedError
from tests.importing.throws import thrown, write_rows

BALLS = {"red": 0.0, "green": 1.0, "blue": 2.0}
"""Names, and m by which they fly apart along y."""


def _paths(noise: float = 0.001) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    made = {name: thrown(noise, seed) for seed, name in enumerate(BALLS)}
    t = made["red"][0]
    return t, {name: p + np.array([0.0, BALLS[name], 0.0]) for name, (_, p) in made.items()}


def _right(data: bf.Dataset, names: list[str]) -> None:
    t, paths = _paths()
    assert data.names == names
    for track, path in zip(data, paths.values(), strict=False):
        np.testing.assert_allclose(track.seconds, t, atol=1e-6)
        np.testing.assert_allclose(track.positions, path, atol=1e-4)


@pytest.mark.parametrize("column", ["marker", "ball", "object", "player", "what"])
@pytest.mark.parametrize("by_time", [True, False])
def test_a_column_of_identities_makes_tracks(column: str, by_time: bool, tmp_path: Path) -> None:
    t, paths = _paths()
    rows = [(name, *row) for name, p in paths.items() for row in np.column_stack((t, p)).tolist()]
    rows = sorted(rows, key=lambda row: row[1]) if by_time else rows
    file = tmp_path / "balls.csv"
    file.write_text(f"{column},t,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in rows))
    _right(bf.import_tracks(file), list(BALLS))


@pytest.mark.parametrize(
    ("column", "shots"), [("marker", 6), ("ball", 6), ("id", 6), ("shot", 2), ("shot_id", 2), ("track_id", 2)]
)
def test_a_ball_that_is_thrown_again_flies_another_shot(column: str, shots: int, tmp_path: Path) -> None:
    """Two balls, three throws each at 10 s: names of balls do not say where shots end, those of shots do."""
    t, paths = _paths()
    rows = [
        (k, *row)
        for k, p in enumerate(list(paths.values())[:2])
        for throw in range(3)
        for row in np.column_stack((t + 10.0 * throw + 3.0 * k, p)).tolist()
    ]
    data = bf.import_tracks(write_rows(tmp_path / "a.csv", f"{column},t,x,y,z", rows))
    assert len(data) == shots
    assert max(track.duration for track in data) < (1.0 if shots == 6 else 21.0)
    assert data.names[0] == ("0-000" if shots == 6 else "0")
    assert len(bf.import_tracks(tmp_path / "a.csv", columns={"trajectory": column})) == 2


@pytest.mark.parametrize("title", ["{ball}_{axis}", "{ball}.{axis}", "{axis}_{ball}", "{ball} {axis} [mm]"])
def test_balls_side_by_side(title: str, tmp_path: Path) -> None:
    t, paths = _paths()
    size = 1e3 if "mm" in title else 1.0
    columns = {
        title.format(ball=name, axis=axis): size * p[:, "xyz".index(axis)]
        for name, p in paths.items()
        for axis in "xyz"
    }
    rows = np.column_stack((t, *columns.values())).tolist()
    _right(bf.import_tracks(write_rows(tmp_path / "balls.csv", ",".join(("time", *columns)), rows)), list(BALLS))


def test_numbered_balls_side_by_side_some_of_them_hidden(tmp_path: Path) -> None:
    t, paths = _paths()
    columns = {
        f"ball{k}_{axis}": p[:, "xyz".index(axis)].tolist() for k, p in enumerate(paths.values()) for axis in "xyz"
    }
    for axis in "xyz":
        columns[f"ball1_{axis}"][:20] = [""] * 20
    rows = list(zip(t.tolist(), *columns.values(), strict=True))
    data = bf.import_tracks(write_rows(tmp_path / "balls.csv", ",".join(("t", *columns)), rows))
    assert data.names == ["ball-0", "ball-1", "ball-2"]
    assert [len(track) for track in data] == [len(t), len(t) - 20, len(t)]
    np.testing.assert_allclose(data["ball-1"].positions, paths["green"][20:], atol=1e-9)


def test_heights_side_by_side(tmp_path: Path) -> None:
    t, paths = _paths()
    heights = np.column_stack((t, *(p[:, 2] + 2.0 * i for i, p in enumerate(paths.values())))).tolist()
    data = bf.import_tracks(write_rows(tmp_path / "drops.csv", "t,red_z,green_z,blue_z", heights))
    assert data.names == list(BALLS)
    assert not any(track.positions[:, :2].any() for track in data)


def test_shots_of_balls_side_by_side(tmp_path: Path) -> None:
    t, paths = _paths()
    rows = [(shot, *row) for shot in "ab" for row in np.column_stack((t, *paths.values())).tolist()]
    header = ",".join(("shot", "t", *(f"{name}_{axis}" for name in paths for axis in "xyz")))
    data = bf.import_tracks(write_rows(tmp_path / "balls.csv", header, rows))
    assert len(data) == 6
    assert all(len(track) == len(t) for track in data)


@pytest.mark.parametrize(("words", "shift"), [(("raw", "filtered"), 1.0), (("left", "right"), 0.02)])
def test_one_ball_measured_twice_is_asked_about(words: tuple[str, str], shift: float, tmp_path: Path) -> None:
    t, p = thrown(0.001)
    header = ",".join(("t", *(f"{name}_{axis}" for name in words for axis in "xyz")))
    with pytest.raises(UndecidedError, match="2 sets of columns may be the ball's x, y, z"):
        bf.import_tracks(write_rows(tmp_path / "a.csv", header, np.column_stack((t, p, p + shift)).tolist()))


def test_balls_within_shots(tmp_path: Path) -> None:
    t, paths = _paths()
    rows = [(shot, name, *row) for shot in ("a", "b") for name, p in paths.items()
            for row in np.column_stack((t, p)).tolist()]  # fmt: skip
    file = tmp_path / "balls.csv"
    file.write_text("shot,ball,t,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in rows))
    _right(bf.import_tracks(file), [f"{shot}-{name}" for shot in ("a", "b") for name in BALLS])


@pytest.mark.parametrize("column", ["ball", "what"])
def test_numbered_shots_of_each_ball(column: str, tmp_path: Path) -> None:
    t, paths = _paths()
    rows = [(name, drop, s, h) for name, p in paths.items() for drop in (1, 2)
            for s, h in np.column_stack((t, p[:, 2])).tolist()]  # fmt: skip
    file = tmp_path / "drops.csv"
    file.write_text(f"{column},drop,time (s),height (m)\n" + "\n".join(",".join(map(str, row)) for row in rows))
    data = bf.import_tracks(file)
    assert data.names == [f"{name}-{drop}" for name in BALLS for drop in (1, 2)]
    assert all(len(track) == len(t) for track in data)


@pytest.mark.parametrize("stamped", [True, False])
def test_qualisys(stamped: bool, tmp_path: Path) -> None:
    t, paths = _paths()
    head = [f"NO_OF_FRAMES\t{len(t)}", "NO_OF_MARKERS\t3", "FREQUENCY\t100", "DATA_INCLUDED\t3D",
            "MARKER_NAMES\t" + "\t".join(BALLS)]  # fmt: skip
    columns = [f"{name} {axis}" for name in BALLS for axis in "XYZ"]
    rows = []
    for i, stamp in enumerate(t):
        cells = [f"{1e3 * value:.3f}" for p in paths.values() for value in p[i]]
        rows.append("\t".join(([str(i + 1), f"{stamp:.5f}"] if stamped else []) + cells))
    head += ["\t".join(["Frame", "Time", *columns])] if stamped else []
    file = tmp_path / "capture.tsv"
    file.write_text("\n".join([*head, *rows]) + "\n")
    _right(bf.import_tracks(file), list(BALLS))


def test_hidden_markers_of_qualisys_are_missing(tmp_path: Path) -> None:
    t, p = thrown(0.001)
    rows = [f"{i + 1}\t{s:.5f}\t" + "\t".join(f"{1e3 * v:.3f}" for v in (q if i % 7 else 0 * q))
            for i, (s, q) in enumerate(zip(t, p, strict=True))]  # fmt: skip
    file = tmp_path / "capture.tsv"
    file.write_text(f"NO_OF_FRAMES\t{len(t)}\nFREQUENCY\t100\nMARKER_NAMES\tball\n" + "\n".join(rows))
    (track,) = bf.import_tracks(file)
    assert len(track) == len(t) - len(t[::7])


def test_motive(tmp_path: Path) -> None:
    t, paths = _paths()
    head = ["Format Version,1.23,Take Name,throw,Export Frame Rate,100.000000,Length Units,Meters", "",
            ",Type," + ",".join(["Marker"] * 9), ",Name," + ",".join(n for n in BALLS for _ in range(3)),
            ",ID," + ",".join(["1"] * 9), ",," + ",".join(["Position"] * 9),
            "Frame,Time (Seconds)," + ",".join("XYZ" * 3)]  # fmt: skip
    turned = {name: np.column_stack((p[:, 0], p[:, 2], -p[:, 1])) for name, p in paths.items()}  # y is up
    rows = [f"{i},{s:.6f}," + ",".join(f"{v:.6f}" for p in turned.values() for v in p[i]) for i, s in enumerate(t)]
    file = tmp_path / "take.csv"
    file.write_text("\n".join([*head, *rows]))
    _right(bf.import_tracks(file), list(BALLS))


def test_vicon(tmp_path: Path) -> None:
    t, paths = _paths()
    head = ["Trajectories", "100", ",," + ",,,".join(f"lab:{n}" for n in BALLS) + ",,",
            "Frame,Sub Frame," + ",".join("XYZ" * 3), ",," + ",".join(["mm"] * 9)]  # fmt: skip
    rows = [f"{i + 1},0," + ",".join(f"{1e3 * v:.4f}" for p in paths.values() for v in p[i]) for i in range(len(t))]
    file = tmp_path / "nexus.csv"
    file.write_text("\n".join([*head, *rows, "", "Events", "100"]))
    _right(bf.import_tracks(file), list(BALLS))


@pytest.mark.parametrize("header", ["t,height [m]", "time,z [m]", "t,x [m],z [m]"])
def test_one_or_two_coordinates(header: str, tmp_path: Path) -> None:
    t, p = thrown(0.001)
    values = np.column_stack((t, *([p[:, 0]] if "x" in header else []), p[:, 2]))
    file = tmp_path / "drop.csv"
    file.write_text(header + "\n" + "\n".join(",".join(map(str, row)) for row in values.tolist()))
    data = bf.import_tracks(file)
    (track,) = data
    np.testing.assert_allclose(track.positions[:, 2], p[:, 2], atol=1e-9)
    assert (track.positions[:, 1] == 0.0).all()
    assert "not measured" in data.info.doubts[0]
    assert bf.estimate(data)["000"].status is bf.Status.OK
