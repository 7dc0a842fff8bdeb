"""Recordings with several balls, missing coordinates and vendors' headers: right, or all decisions asked at once."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ballfg as bf
from ballfg.importing.choices import AllUndecidedError, UndecidedError
from tests.importing.throws import thrown

NAMES = ("red", "green", "blue")
Paths = dict[str, np.ndarray]


def balls(count: int = 3, drop: bool = False) -> tuple[np.ndarray, Paths]:
    """Stamps (n,) s and positions (n, 3) m of balls one beside the other; drop: cut before they bounce."""
    made = [thrown(0.001, seed) for seed in range(count)]
    t = made[0][0]
    kept = t < (0.3 if drop else 9.0)
    paths = {
        name: p[kept] + np.array([0.0, float(k), 0.0])
        for k, (name, (_, p)) in enumerate(zip(NAMES, made, strict=False))
    }
    return t[kept], paths


def _lines(path: Path, header: str, rows: list[list[object]], separator: str = ",") -> Path:
    path.write_text("\n".join([header, *(separator.join(map(str, row)) for row in rows)]))
    return path


def _long(t: np.ndarray, paths: Paths, size: float = 1.0) -> list[list[object]]:
    return [[name, s, *(size * q).tolist()] for name, p in paths.items() for s, q in zip(t.tolist(), p, strict=True)]


def numbers_for_names(f: Path) -> Path:
    t, paths = balls()
    rows = sorted(([NAMES.index(str(row[0])) + 7, *row[1:]] for row in _long(t, paths)), key=lambda row: row[1])
    return _lines(f / "a.csv", "object_id,t,x,y,z", rows)


def semicolons_and_commas(f: Path) -> Path:
    rows = [[row[0], *(str(cell).replace(".", ",") for cell in row[1:])] for row in _long(*balls())]
    return _lines(f / "a.csv", "Ball;Zeit;X;Y;Z", rows, ";")


def millimetres_by_marker(f: Path) -> Path:
    return _lines(f / "a.csv", "Marker,Time [s],X [mm],Y [mm],Z [mm]", _long(*balls(), 1e3))


def a_json_list_with_names(f: Path) -> Path:
    keys = ("player", "t", "x", "y", "z")
    (f / "a.json").write_text(json.dumps([dict(zip(keys, row, strict=True)) for row in _long(*balls())]))
    return f / "a.json"


def json_of_balls_with_samples(f: Path) -> Path:
    t, paths = balls()
    samples = {n: [{"t": s, "x": q[0], "y": q[1], "z": q[2]} for s, q in zip(t.tolist(), p.tolist(), strict=True)]
               for n, p in paths.items()}  # fmt: skip
    (f / "a.json").write_text(json.dumps({"balls": [{"name": n, "samples": s} for n, s in samples.items()]}))
    return f / "a.json"


def a_file_for_each_ball(f: Path) -> Path:
    t, paths = balls()
    (f / "take").mkdir()
    for name, p in paths.items():
        _lines(f / "take" / f"{name}.csv", "t,x,y,z", np.column_stack((t, p)).tolist())
    return f / "take"


def frames_of_balls(f: Path) -> Path:
    t, paths = balls()
    rows = [[row[0], round(100 * float(str(row[1]))), *row[2:]] for row in _long(t, paths)]
    return _lines(f / "a.csv", "ball,frame,x,y,z", rows)


def frames_of_falls_without_a_bounce(f: Path) -> Path:
    t, paths = balls(drop=True)
    rows = [[row[0], round(100 * float(str(row[1]))), *row[2:]] for row in _long(t, paths)]
    return _lines(f / "a.csv", "ball,frame,x,y,z", rows)


def heights(f: Path) -> Path:
    t, paths = balls(1)
    return _lines(f / "a.csv", "time,height [cm]", np.column_stack((t, 100 * paths["red"][:, 2])).tolist())


def heights_of_balls(f: Path) -> Path:
    return _lines(f / "a.csv", "ball,t,z [m]", [[row[0], row[1], row[4]] for row in _long(*balls())])


def heights_without_a_bounce(f: Path) -> Path:
    t, paths = balls(1, drop=True)
    rows = [[round(100 * s), h] for s, h in zip(t.tolist(), paths["red"][:, 2].tolist(), strict=True)]
    return _lines(f / "a.csv", "frame,z [m]", rows)


def two_coordinates(f: Path) -> Path:
    return _lines(f / "a.csv", "ball,t,x [m],z [m]", [[*row[:3], row[4]] for row in _long(*balls())])


def balls_in_columns(f: Path) -> Path:
    t, paths = balls(2)
    return _lines(f / "a.csv", "t," + ",".join(f"{n}_{a}" for n in paths for a in "xyz"),
                  np.column_stack((t, *paths.values())).tolist())  # fmt: skip


def balls_in_columns_of_frames(f: Path) -> Path:
    t, paths = balls(2, drop=True)
    return _lines(f / "a.csv", "frame," + ",".join(f"{n}_{a}" for n in paths for a in "xyz"),
                  np.column_stack((np.round(100 * t), *paths.values())).tolist())  # fmt: skip


def _qualisys(f: Path, paths: Paths, t: np.ndarray, stamped: bool) -> Path:
    head = [f"NO_OF_FRAMES\t{len(t)}", f"NO_OF_MARKERS\t{len(paths)}", "FREQUENCY\t100", "TIME_STAMP\t2026-01-01",
            "DATA_INCLUDED\t3D", "MARKER_NAMES\t" + "\t".join(paths)]  # fmt: skip
    head += ["\t".join(["Frame", "Time", *(f"{n} {a}" for n in paths for a in "XYZ")])] if stamped else []
    rows = [([i + 1, f"{s:.5f}"] if stamped else []) + [f"{1e3 * v:.3f}" for p in paths.values() for v in p[i]]
            for i, s in enumerate(t)]  # fmt: skip
    (f / "a.tsv").write_text("\n".join([*head, *("\t".join(map(str, row)) for row in rows)]))
    return f / "a.tsv"


def qualisys(f: Path) -> Path:
    t, paths = balls()
    return _qualisys(f, paths, t, stamped=True)


def qualisys_without_times_or_bounces(f: Path) -> Path:
    t, paths = balls(drop=True)
    return _qualisys(f, paths, t, stamped=False)


def _motive(f: Path, kind: str, unit: str, size: float, each: int) -> Path:
    t, paths = balls()
    head = [f"Format Version,1.23,Take Name,throw,Capture Frame Rate,100.000000,Length Units,{unit}", "",
            ",Type," + ",".join([kind] * (3 * each)), ",Name," + ",".join(n for n in paths for _ in range(each)),
            ",ID," + ",".join(["1"] * (3 * each)),
            ",," + ",".join((["Rotation"] * 4 + ["Position"] * 3 if each == 7 else ["Position"] * 3) * 3),
            "Frame,Time (Seconds)," + ",".join((["X", "Y", "Z", "W"] if each == 7 else []) + ["X", "Y", "Z"])
            + ("," + ",".join((["X", "Y", "Z", "W"] if each == 7 else []) + ["X", "Y", "Z"])) * 2]  # fmt: skip
    turned = {n: size * np.column_stack((p[:, 0], p[:, 2], -p[:, 1])) for n, p in paths.items()}
    quaternion = ["0.1", "0.2", "0.3", "0.9"] if each == 7 else []
    rows = [[i, f"{s:.6f}", *(c for p in turned.values() for c in (*quaternion, *(f"{v:.6f}" for v in p[i])))]
            for i, s in enumerate(t)]  # fmt: skip
    (f / "a.csv").write_text("\n".join([*head, *(",".join(map(str, row)) for row in rows)]))
    return f / "a.csv"


def motive_markers(f: Path) -> Path:
    return _motive(f, "Marker", "Meters", 1.0, 3)


def motive_bodies_in_millimetres(f: Path) -> Path:
    return _motive(f, "Rigid Body", "Millimeters", 1e3, 7)


def vicon(f: Path) -> Path:
    t, paths = balls()
    head = ["Trajectories", "100", ",," + ",,,".join(f"lab:{n}" for n in paths) + ",,",
            "Frame,Sub Frame," + ",".join("XYZ" * 3), ",," + ",".join(["mm"] * 9)]  # fmt: skip
    rows = [f"{i + 1},0," + ",".join(f"{1e3 * v:.4f}" for p in paths.values() for v in p[i]) for i in range(len(t))]
    (f / "a.csv").write_text("\n".join([*head, *rows]))
    return f / "a.csv"


def dates_of_balls(f: Path) -> Path:
    rows = [[row[0], f"2026-03-01T12:00:{float(str(row[1])):09.6f}Z", *row[2:]] for row in _long(*balls())]
    return _lines(f / "a.csv", "ball,timestamp,x,y,z", rows)


SOURCES: tuple[Callable[[Path], Path], ...] = (
    numbers_for_names, semicolons_and_commas, millimetres_by_marker, a_json_list_with_names, json_of_balls_with_samples,
    a_file_for_each_ball, frames_of_balls, frames_of_falls_without_a_bounce, heights, heights_of_balls,
    heights_without_a_bounce, two_coordinates, balls_in_columns, balls_in_columns_of_frames, qualisys,
    qualisys_without_times_or_bounces, motive_markers, motive_bodies_in_millimetres, vicon, dates_of_balls,
)  # fmt: skip
TRUTH = {"rate": 100.0, "length": "m", "time": "s", "up": "z"}
"""Answers to questions."""
DECIDED: dict[Callable[[Path], Path], tuple[str, ...]] = {
    frames_of_balls: ("rate",),
    frames_of_falls_without_a_bounce: ("rate",),
    heights_without_a_bounce: ("rate",),
    balls_in_columns_of_frames: ("rate",),
}
"""What the source does not say, all of which the one refusal asks."""


@pytest.mark.parametrize("make", SOURCES, ids=lambda make: make.__name__)
def test_right_or_asked_at_once(make: Callable[[Path], Path], tmp_path: Path) -> None:
    source, known = make(tmp_path), {}
    if make in DECIDED:
        with pytest.raises(UndecidedError) as refused:
            bf.import_tracks(source)
        error = refused.value
        questions = error.questions if isinstance(error, AllUndecidedError) else (error,)
        assert tuple(question.option for question in questions) == DECIDED[make]
        assert all(f"--{question.option}" in str(error) for question in questions)
        arguments = str(error).rpartition("In Python: ")[2].rstrip(".")
        answers = eval(f"dict({arguments})")  # as a user pastes them
        assert list(answers) == [question.option.replace("-", "_") for question in questions]
        for question in questions:
            known[question.option.replace("-", "_")] = TRUTH[question.option]
    data = bf.import_tracks(source, **known)
    t, paths = balls(drop=len(next(iter(data))) < 40)
    two = make in (balls_in_columns, balls_in_columns_of_frames)
    assert len(data) == (1 if make in (heights, heights_without_a_bounce) else 2 if two else 3)
    by_name = make is a_file_for_each_ball  # in the order of the alphabet
    for track, path in zip(data, [paths[track.name] for track in data] if by_name else paths.values(), strict=False):
        np.testing.assert_allclose(track.seconds, t - t[0] + track.seconds[0], atol=2e-5)
        measured = [axis for axis in range(3) if track.positions[:, axis].any()]
        np.testing.assert_allclose(track.positions[:, measured], path[:, measured], atol=2e-4)
        assert 2 in measured
