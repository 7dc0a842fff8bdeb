"""`detections.csv` by trajectory: the sightings of each ball in a dataset."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from ballfg.checks import did_you_mean
from ballfg.tracks import csv_errors
from ballfg.tracks.checks import check_step
from ballfg.tracks.rows import KEY
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.table import TableWriter

Array = NDArray[np.float64]
Rule = tuple[str, Callable[[Array], NDArray[np.bool_]]]
"""What the numbers of a column must be, in words and as a test."""

DETECTIONS_FILE: Final = "detections.csv"
CAMERA: Final = "camera"
PLACE: Final = ("t", "u", "v")
NOISE: Final = ("sigma_u", "sigma_v", "rho_uv")
SCORE: Final = "score"
UNSTATED: Final = {"sigma_u": 0.5, "sigma_v": 0.5, "rho_uv": 0.0}
"""px. Half a pixel: what a detector reaches that looks for the middle of a patch."""
LEAST_SIGMA: Final = 1e-4
"""px. No camera tells a ball's centre better; a graph with far surer pixels cannot be solved in double precision."""
_SIGMA: Final[Rule] = (f"{LEAST_SIGMA:g} px or more", lambda x: x >= LEAST_SIGMA)
RULES: Final[Mapping[str, Rule]] = {
    "sigma_u": _SIGMA,
    "sigma_v": _SIGMA,
    "rho_uv": ("between -1 and 1", lambda x: np.abs(x) < 1.0),
}


@dataclass(frozen=True)
class _Table:
    """The rows of the file that name a ball.

    Attributes:
        path: of the file.
        lines: (n,) row numbers in the file, from 0.
        names: (n,) of the balls.  camera: (n,) numbers of the cameras.
        values: (n,) of each numeric column.
    """

    path: Path
    lines: NDArray[np.int64]
    names: NDArray[np.str_]
    camera: NDArray[np.int64]
    values: dict[str, Array]


def read_sightings(
    path: str | os.PathLike[str], time_offsets: Mapping[str, float]
) -> tuple[dict[str, Sightings], list[str]]:
    """The sightings of each ball that the file names.

    Rows without a trajectory are candidates of which nobody knows the ball; they are left out. Of several rows of one
    ball, camera and stamp the one with the highest score counts. The order of rows is free.

    Args:
        path: a table `trajectory,t,camera,u,v` (t in s, as the camera writes it, u and v in px), optionally with
            `sigma_u`, `sigma_v` (px), `rho_uv` and `score`.
        time_offsets: s, by camera of the rig: rows are put in the order of t less the offset.
    Returns: sightings by trajectory, in the order in which the trajectories first appear; what was ignored, one
        sentence each.
    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a missing or repeated column, a cell out of its range, an unknown camera, or several candidates of
            one ball that no score tells apart; the message names file, line and column.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a table of detections; there is none. Correct the path.")
    header = csv_errors.read_header(path)
    check_header(path, header, _REQUIRED, _KNOWN)
    table, nameless = _read(path, header, list(time_offsets))
    notes = [f"{path.name}: column {name!r} ignored" for name in header if name not in _KNOWN]
    if nameless:
        notes.append(f"{path.name}: {nameless} rows without a trajectory left out")
    rows, doubles = _chosen(table)
    if doubles:
        notes.append(f"{path.name}: {doubles} candidates with a lower score than another of the same ball left out")
    for number, camera in enumerate(time_offsets):
        check_step(f"{path}, camera {camera!r}", np.unique(table.values["t"][rows][table.camera[rows] == number]))
    offsets = np.array(list(time_offsets.values()))
    rows = rows[np.argsort((table.values["t"] - offsets[table.camera])[rows], kind="stable")]
    found = {str(name): rows[table.names[rows] == name] for name in dict.fromkeys(table.names.tolist())}
    return {name: _sightings(table, mine, tuple(time_offsets)) for name, mine in found.items()}, notes


def write_sightings(path: str | os.PathLike[str], balls: Iterable[tuple[str, Sightings]]) -> None:
    """Writes a `detections.csv` with the trajectory of each row; pixels and stamps read back bit for bit.

    Args: path: ends in .csv.  balls: name of the trajectory and sightings of each.
    Raises: ValueError: no balls, or another ending. FileNotFoundError: the folder does not exist.
    """
    with TableWriter(path) as table:
        for name, seen in balls:
            sigma_u, sigma_v = (np.sqrt(seen.covariances[:, i, i]) for i in (0, 1))
            table.write(
                {
                    KEY: name,
                    "t": seen.times,
                    CAMERA: np.array(seen.cameras, dtype=object)[seen.camera],
                    "u": seen.pixels[:, 0],
                    "v": seen.pixels[:, 1],
                    "sigma_u": sigma_u,
                    "sigma_v": sigma_v,
                    "rho_uv": seen.covariances[:, 0, 1] / (sigma_u * sigma_v),
                }
            )


_REQUIRED: Final = (KEY, "t", CAMERA, "u", "v")
_KNOWN: Final = (*_REQUIRED, *NOISE, SCORE)


def check_header(path: Path, header: Sequence[str], required: Sequence[str], known: Sequence[str]) -> None:
    """Refuses a header without a needed column or with a known one twice.

    Args: path: of the table.  header: its columns.  required: those needed.  known: those that mean something.
    Raises: ValueError: naming the column.
    """
    for name in required:
        if name not in header:
            raise ValueError(
                f"{path}: column {name!r} is missing; expected {','.join(required)}, got {','.join(header)}. "
                f"Add or rename it.{did_you_mean(name, [other for other in header if other not in known])}"
            )
    twice = [name for name in known if list(header).count(name) > 1]
    if twice:
        raise ValueError(f"{path}: column {twice[0]!r} must appear once; got {','.join(header)}. Rename one of them.")


def _read(path: Path, header: list[str], cameras: list[str]) -> tuple[_Table, int]:
    """The rows that name a ball, checked, and how many name none."""
    numeric: list[str] = [name for name in (*PLACE, *NOISE, SCORE) if name in header]
    convert = pa_csv.ConvertOptions(
        column_types={KEY: pa.string(), CAMERA: pa.string(), **dict.fromkeys(numeric, pa.float64())},
        include_columns=[KEY, CAMERA, *numeric],
        null_values=[],
    )
    try:
        read = pa_csv.read_csv(path, pa_csv.ReadOptions(use_threads=False), convert_options=convert)
    except pa.ArrowInvalid as error:
        raise csv_errors.explain(path, numeric, str(error)) from None
    names = np.array(read.column(KEY).to_pylist(), dtype=np.str_)
    seen_by = np.array(read.column(CAMERA).to_pylist(), dtype=np.str_)
    (lines,) = np.nonzero(np.char.strip(names) != "")
    values = {name: np.asarray(read.column(name).to_numpy(), dtype=np.float64)[lines] for name in numeric}
    check_values(path, values, lines)
    strange = ~np.isin(seen_by[lines], cameras)
    if strange.any():
        got = str(seen_by[lines][int(np.argmax(strange))])
        raise ValueError(
            f"{place(path, lines[strange], CAMERA)} must be a camera: {', '.join(cameras)}; got {got!r}. "
            f"Rename it, or add it to the cameras' file.{did_you_mean(got, cameras)}"
        )
    values |= {name: np.full(len(lines), value) for name, value in UNSTATED.items() if name not in values}
    numbers = {name: number for number, name in enumerate(cameras)}
    camera = np.array([numbers[name] for name in seen_by[lines].tolist()], dtype=np.int64)
    return _Table(path, lines, names[lines], camera, values), len(names) - len(lines)


def check_values(
    path: Path, values: Mapping[str, Array], lines: NDArray[np.int64], rules: Mapping[str, Rule] = RULES
) -> None:
    """Refuses cells out of their range.

    Args:
        path: of the table.  values: (n,) of each column.  lines: (n,) numbers of their rows in the file.
        rules: by column; others must be finite.
    Raises: ValueError: naming line and column.
    """
    for name, column in values.items():
        rule, holds = rules.get(name, ("finite", np.isfinite))
        wrong = ~(np.isfinite(column) & holds(column))
        if wrong.any():
            raise ValueError(
                f"{place(path, lines[wrong], name)} must be {rule}; got {column[wrong][0]:g}. "
                "Correct it or delete the line."
            )


def place(path: Path, lines: NDArray[np.int64], column: str) -> str:
    """The first of some rows of the file, and the column, for a message."""
    (line,) = csv_errors.lines_of_rows(path, [int(lines[0])])
    return f"{path}, line {line}, column {column!r}:"


def _chosen(table: _Table) -> tuple[NDArray[np.int64], int]:
    """One row for each ball, camera and stamp, the best scored, ascending; and how many others there are.

    Raises: ValueError: two rows of the same score.
    """
    score = table.values.get(SCORE, np.zeros(len(table.lines)))
    order = np.lexsort((-score, table.values["t"], table.camera, table.names))
    same = np.ones(max(len(order) - 1, 0), dtype=bool)
    for column in (table.names, table.camera, table.values["t"]):
        same &= column[order[1:]] == column[order[:-1]]
    tied = same & (score[order[1:]] == score[order[:-1]])
    if tied.any():
        pair = np.sort(table.lines[order[int(np.argmax(tied)) :][:2]])
        one, other = csv_errors.lines_of_rows(table.path, pair.tolist())
        raise ValueError(
            f"{table.path}, lines {one} and {other}: one ball must be seen once in a frame, or the scores must tell "
            "which candidate it is; they do not. Delete one of them."
        )
    return np.sort(order[np.append(True, ~same)]) if len(order) else order, int(same.sum())


def _sightings(table: _Table, rows: NDArray[np.int64], cameras: tuple[str, ...]) -> Sightings:
    t, u, v, sigma_u, sigma_v, rho = (table.values[name][rows] for name in (*PLACE, *NOISE))
    across = rho * sigma_u * sigma_v
    covariances = np.stack((sigma_u**2, across, across, sigma_v**2), axis=-1).reshape(-1, 2, 2)
    return Sightings(cameras, table.camera[rows], t, np.column_stack((u, v)), covariances)
