"""Sources with a mistake in each: imported right, or refused in one line that names what would do it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ballfg as bf
from ballfg.importing.formats.sources import tables_of
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import Track, read_dataset
from tests.commands import refused, status
from tests.importing.test_forms import Y_UP, same_shots
from tests.importing.throws import thrown

Rows = list[list[str]]
Columns = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def shots() -> list[Track]:
    return [one.track for one in simulate(SimulationConfig(6, rate=120.0, seed=5))]


def columns_of(shots: list[Track], turn: np.ndarray | None = None, size: float = 1.0) -> Columns:
    turn = np.eye(3) if turn is None else turn
    positions = np.concatenate([size * shot.positions @ turn.T for shot in shots])
    names = np.concatenate([[shot.name] * len(shot) for shot in shots])
    times = np.concatenate([shot.times for shot in shots])
    return {"shot": names, "t": times, **{axis: positions[:, i] for i, axis in enumerate("xyz")}}


def written(path: Path, columns: Columns, header: str | None = None, separator: str = ",") -> Path:
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [separator.join(str(cell) for cell in row) for row in rows]
    path.write_text("\n".join([header if header is not None else separator.join(columns), *lines]), encoding="utf-8")
    return path


def renamed(columns: Columns, **names: str) -> Columns:
    return {names.get(name, name): values for name, values in columns.items()}


# Each makes a source of the shots with one mistake. ------------------------------------------------------------------


def unit_that_is_none(f: Path, s: list[Track]) -> Path:
    return written(f / "a.csv", renamed(columns_of(s, size=1e3), x="x [parsec]", y="y [parsec]", z="z [parsec]"))


def feet_in_the_header_of_centimetres(f: Path, s: list[Track]) -> Path:
    return written(f / "a.csv", renamed(columns_of(s, size=1e2), x="x [ft]", y="y [ft]", z="z [ft]"))


def seconds_in_the_header_of_milliseconds(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s)
    columns["t"] = 1e3 * columns["t"]
    return written(f / "a.csv", renamed(columns, t="t [s]"))


def two_clocks(f: Path, s: list[Track]) -> Path:
    columns = renamed(columns_of(s), t="time_camera")
    jitter = np.random.default_rng(0).uniform(0.0, 0.004, len(columns["x"]))
    return written(f / "a.csv", columns | {"time_host": columns["time_camera"] + 3.0 + jitter})


def text_between_numbers(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s)
    x = columns["x"].astype(object)
    x[[20, 21, 700]] = "occluded"
    return written(f / "a.csv", columns | {"x": x})


def numbers_with_a_letter(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s)
    return written(f / "a.csv", {**columns, "y": np.array([f"y{value}" for value in columns["y"].tolist()])})


def units_in_every_cell(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s, size=1e3)
    return written(f / "a.csv", columns | {a: np.array([f"{v} mm" for v in columns[a].tolist()]) for a in "xyz"})


def no_z(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s)
    del columns["z"]
    return written(f / "a.csv", columns)


def pixels(f: Path, s: list[Track]) -> Path:
    columns = {"Frame": np.arange(200), "Visibility": np.ones(200, dtype=int), "X": np.arange(200) * 3.0}
    return written(f / "ball.csv", columns | {"Y": 400.0 - np.arange(200)})


def nothing(f: Path, s: list[Track]) -> Path:
    (f / "a.csv").write_bytes(b"")
    return f / "a.csv"


def a_header_alone(f: Path, s: list[Track]) -> Path:
    (f / "a.csv").write_text("t,x,y,z\n", encoding="utf-8")
    return f / "a.csv"


def a_cell_without_end(f: Path, s: list[Track]) -> Path:
    """Of more characters than Python's reader of CSV takes."""
    (f / "a.csv").write_text("t,x,y,z\n0.0,1.0,2.0," + "3" * 200_000 + "\n", encoding="utf-8")
    return f / "a.csv"


def rubbish(f: Path, s: list[Track]) -> Path:
    (f / "a.csv").write_bytes(np.random.default_rng(0).bytes(5000))
    return f / "a.csv"


def json_cut_off(f: Path, s: list[Track]) -> Path:
    text = json.dumps([{"t": t, "pos": p.tolist()} for t, p in zip(s[0].times.tolist(), s[0].positions, strict=True)])
    (f / "a.json").write_text(text[: len(text) // 2], encoding="utf-8")
    return f / "a.json"


def parquet_cut_off(f: Path, s: list[Track]) -> Path:
    (f / "a.parquet").write_bytes(b"PAR1" + b"\x15\x04" * 300)
    return f / "a.parquet"


def one_stamp_for_all(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s)
    return written(f / "a.csv", columns | {"t": np.full(len(columns["t"]), 5.0)})


def y_points_down(f: Path, s: list[Track]) -> Path:
    return written(f / "a.csv", columns_of(s, np.diag([1.0, -1.0, -1.0]) @ Y_UP))


def rows_from_last_to_first(f: Path, s: list[Track]) -> Path:
    columns = {name: values[::-1] for name, values in columns_of(s[:1]).items() if name != "shot"}
    return written(f / "a.csv", columns)


def zeros_for_missing_samples(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s)
    for axis in "xyz":
        columns[axis][[30, 31, 500]] = 0.0
    columns["x"] = np.where(columns["x"] == 0.0, 0.0, columns["x"])
    return written(f / "a.csv", columns)


def two_balls_at_once(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s[:2])
    del columns["shot"]
    both = {name: np.concatenate([values, values + (2.0 if name == "y" else 0.0)]) for name, values in columns.items()}
    order = np.argsort(np.tile(np.arange(len(columns["t"])), 2), kind="stable")
    return written(f / "a.csv", {name: values[order] for name, values in both.items()})


def frames_without_a_rate(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s)
    columns["t"] = (120.0 * columns["t"]).round().astype(int)
    return written(f / "a.csv", renamed(columns, t="frame"))


def one_ball_twice_in_columns(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s)
    more = {f"right_{axis}": columns[axis] + 0.01 for axis in "xyz"}
    return written(f / "a.csv", renamed(columns, x="left_x", y="left_y", z="left_z") | more)


def names_that_say_nothing(f: Path, s: list[Track]) -> Path:
    columns = columns_of(s, size=1e3)
    return written(f / "a.csv", renamed(columns, shot="A", t="B", x="C", y="D", z="E"))


def no_such_file(f: Path, s: list[Track]) -> Path:
    return f / "shots.csv"


def a_pipe(f: Path, s: list[Track]) -> Path:
    """As of `ballfg import <(zcat shots.csv.gz)`."""
    os.mkfifo(f / "shots.csv")
    return f / "shots.csv"


def a_folder_of_pictures(f: Path, s: list[Track]) -> Path:
    (f / "pictures").mkdir()
    (f / "pictures" / "a.png").write_bytes(b"\x89PNG")
    return f / "pictures"


Mistake = Callable[[Path, list[Track]], Path]
REFUSED: dict[Mistake, str] = {
    feet_in_the_header_of_centimetres: "Decide it with --length cm",
    seconds_in_the_header_of_milliseconds: "Decide it with --time ms",
    two_clocks: "--columns t=time_camera (or t=time_host)",
    numbers_with_a_letter: "column 'y' must hold numbers; it holds 'y",
    no_z: "--columns z=NAME",
    pixels: "ballfg track DETECTIONS --cameras",
    nothing: "the file is empty",
    a_header_alone: "must hold rows of numbers",
    a_cell_without_end: "must hold rows of numbers: a time and x, y, z; field larger than field limit (131072)",
    rubbish: "it is binary and begins with",
    json_cut_off: "as in a file that was cut off",
    parquet_cut_off: "must be a whole Parquet file",
    one_stamp_for_all: "--columns t=NAME",
    two_balls_at_once: "--columns trajectory=NAME",
    frames_without_a_rate: "--rate 120",
    one_ball_twice_in_columns: "--columns x=left_x,y=left_y,z=left_z (or x=right_x,y=right_y,z=right_z)",
    no_such_file: "source must exist",
    a_pipe: "is a pipe or a device. Write what comes to a file",
    a_folder_of_pictures: "must hold files of measurements",
}
"""What the one line says; most name an option, the others a file that holds no measurements."""
IMPORTED: tuple[Mistake, ...] = (
    unit_that_is_none, text_between_numbers, units_in_every_cell, y_points_down, zeros_for_missing_samples,
    names_that_say_nothing,
)  # fmt: skip


@pytest.mark.parametrize("mistake", REFUSED, ids=lambda mistake: mistake.__name__)
def test_refused(mistake: Mistake, shots: list[Track], tmp_path: Path) -> None:
    source = mistake(tmp_path, shots)
    assert REFUSED[mistake] in refused("import", source, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("mistake", IMPORTED, ids=lambda mistake: mistake.__name__)
def test_imported(mistake: Mistake, shots: list[Track], tmp_path: Path) -> None:
    source = mistake(tmp_path, shots)
    assert status("import", source, "--out", tmp_path / "out") == 0
    data = list(read_dataset(tmp_path / "out"))
    whole = [track if len(one) == len(track) else _without(track, one) for track, one in zip(shots, data, strict=True)]
    assert sum(len(track) for track in shots) - sum(len(track) for track in whole) in (0, 3)
    same_shots(data, whole)


def _without(track: Track, found: Track) -> Track:
    """The samples of a track whose stamps were imported."""
    return Track(*(values[np.isin(track.times, found.times)] for values in (track.times, track.positions)))


@pytest.mark.parametrize("mark", [0.0, -1.0, -9999.0])
def test_a_mark_in_all_coordinates_is_no_position(mark: float) -> None:
    """The ball begins 0.2 m from the origin, where a row of zeros is near to some samples but not to its neighbours."""
    t, p = thrown(0.001)
    p -= [0.2, 0.0, p[0, 2]]
    marked = p.copy()
    marked[[33, 34, 50, len(t) - 1]] = mark
    (track,) = bf.import_tracks(np.column_stack((t, marked)), up="z", length="m", time="s")
    seen = (marked == p).all(axis=1)
    np.testing.assert_array_equal(track.times, t[seen])
    np.testing.assert_array_equal(track.positions, p[seen])


def test_rows_from_last_to_first(shots: list[Track], tmp_path: Path) -> None:
    source = rows_from_last_to_first(tmp_path, shots)
    assert status("import", source, "--out", tmp_path / "out") == 0
    same_shots(list(read_dataset(tmp_path / "out")), shots[:1])


OPTIONS: dict[Mistake, list[str]] = {
    feet_in_the_header_of_centimetres: ["--length", "cm"],
    seconds_in_the_header_of_milliseconds: ["--time", "ms"],
    two_clocks: ["--columns", "t=time_camera"],
    frames_without_a_rate: ["--rate", "120"],
    one_ball_twice_in_columns: ["--columns", "x=left_x,y=left_y,z=left_z"],
}


@pytest.mark.parametrize("mistake", OPTIONS, ids=lambda mistake: mistake.__name__)
def test_the_option_does_it(mistake: Mistake, shots: list[Track], tmp_path: Path) -> None:
    source = mistake(tmp_path, shots)
    assert status("import", source, "--out", tmp_path / "out", *OPTIONS[mistake]) == 0
    same_shots(list(read_dataset(tmp_path / "out")), shots)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--length", "metre"], "--length must be one of m, cm, mm, in, ft; got 'metre'"),
        (["--up", "+z"], "--up must be one of x, -x, y, -y, z, -z"),
        (["--columns", "t=clock"], "has no 'clock'"),
        (["--columns", "time=t"], "--columns must name roles"),
        (["--columns", "t"], "--columns must be written role=name"),
        (["--key", "second"], "--key must name a table"),
        (["--format", "xlsx"], "--format must be csv or parquet"),
        (["--rate", "-5"], "--rate must be finite and above 0"),
    ],
)
def test_bad_options(shots: list[Track], tmp_path: Path, words: list[str], message: str) -> None:
    source = written(tmp_path / "a.csv", columns_of(shots[:1]))
    assert message in refused("import", source, "--out", tmp_path / "out", *words)


def test_what_is_there_stays(shots: list[Track], tmp_path: Path) -> None:
    source = written(tmp_path / "a.csv", columns_of(shots))
    out = tmp_path / "out"
    assert status("import", source, "--out", out) == 0
    before = (out / "tracks.csv").read_bytes()
    assert "Replace it with --force" in refused("import", source, "--out", out, "--length", "mm")
    assert (out / "tracks.csv").read_bytes() == before
    assert status("import", source, "--out", out, "--force", "--format", "parquet") == 0
    assert sorted(file.name for file in out.iterdir()) == ["dataset.yaml", "import.html", "tracks.parquet"]


@pytest.mark.parametrize("simulated", [True, False])
def test_the_truth_of_other_tracks_goes_with_them(shots: list[Track], tmp_path: Path, *, simulated: bool) -> None:
    """Beside a dataset that was not simulated, a model is somebody's own."""
    source, out = written(tmp_path / "a.csv", columns_of(shots)), tmp_path / "out"
    assert status("simulate", "--tracks", 1, "--out", out) == 0
    if not simulated:
        (out / "truth.yaml").unlink()
        (out / "truth.csv").unlink()
    assert status("import", source, "--out", out, "--force") == 0
    left = {"dataset.yaml", "import.html", "tracks.csv"} | (set() if simulated else {"model.yaml"})
    assert {file.name for file in out.iterdir()} == left


def test_a_name_that_no_file_can_have_is_told_with_its_row(shots: list[Track], tmp_path: Path) -> None:
    columns = columns_of(shots)
    columns["shot"] = np.where(columns["shot"] == shots[1].name, "b\x1b[2J", columns["shot"])
    source = written(tmp_path / "a.csv", columns)
    said = refused("import", source, "--out", tmp_path / "out")
    assert f"row {len(shots[0]) + 1}, column 'shot': must be printable text of one line" in said
    assert "\x1b" not in said


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", "[" + "0," * 8_000_000 + "0]", "is too large for JSON: it must hold at most 8000000 values"),
        ("a.json", "[" + "[[0]]," * 150_000 + "0]", "must have at most 100000 lists of samples"),
        ("a.csv", "1," * 200_000, "must have lines of at most 262144 characters; one has 400000"),
        ("a.csv", "1," * 10_001 + "\n" + "1," * 10_001, "must have at most 10000 columns"),
    ],
)
def test_text_without_end_is_refused(name: str, text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=words):
        tables_of(tmp_path / name)


@pytest.mark.parametrize("names", [["1.1", "1.10"], [str(10**24), str(10**24 + 1)], [str(2**63), str(2**63 + 2)]])
def test_shots_whose_names_are_one_number_stay_apart(names: list[str], shots: list[Track], tmp_path: Path) -> None:
    lines, end = ["trajectory,t,x,y,z"], 0.0
    for name, shot in zip(names, shots, strict=False):  # one clock that goes on
        rows = np.column_stack((end + shot.seconds, shot.positions)).tolist()
        lines += [",".join(map(str, (name, *row))) for row in rows]
        end += shot.seconds[-1] + 1.0
    source = tmp_path / "shots.csv"
    source.write_text("\n".join(lines))
    assert status("import", source, "--out", tmp_path / "out") == 0
    found = list(read_dataset(tmp_path / "out"))
    assert [(track.name, len(track)) for track in found] == [
        (name, len(shot)) for name, shot in zip(names, shots, strict=False)
    ]


def test_an_import_into_its_own_source_does_not_take_itself_in(shots: list[Track], tmp_path: Path) -> None:
    written(tmp_path / "shots.csv", columns_of(shots))
    for flag in ((), ("--force",), ("--force",)):
        assert status("import", tmp_path, "--out", tmp_path / "out", *flag) == 0
        assert len(read_dataset(tmp_path / "out")) == len(shots)
