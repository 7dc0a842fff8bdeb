"""`detections.csv` by trajectory: the sightings of each ball in a dataset."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.tracks import csv_files
from ballfg.tracks.checks import check_step
from ballfg.tracks.detection_columns import (
    CAMERA,
    OPTIONAL,
    SCORE,
    UNSTATED,
    check_cameras,
    check_values,
    covariances,
    read_columns,
    seen_columns,
)
from ballfg.tracks.rows import KEY
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.table import TableWriter

Array = NDArray[np.float64]

DETECTIONS_FILE: Final = "detections.csv"
REQUIRED: Final = (KEY, "t", CAMERA, "u", "v")


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
    header, table, nameless = _read(path, list(time_offsets))
    notes = [f"{path.name}: column {name!r} ignored" for name in header if name not in (*REQUIRED, *OPTIONAL)]
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
            camera = np.array(seen.cameras, dtype=object)[seen.camera]
            table.write({KEY: name} | seen_columns(seen.times, camera, seen.pixels, seen.covariances))


def _read(path: Path, cameras: list[str]) -> tuple[list[str], _Table, int]:
    """The header, the rows that name a ball, checked, and how many name none."""
    header, texts, numbers = read_columns(path, REQUIRED)
    (lines,) = np.nonzero(np.char.strip(texts[KEY]) != "")
    names, seen_by = texts[KEY][lines], texts[CAMERA][lines]
    values = {name: column[lines] for name, column in numbers.items()}
    check_values(path, values, lines)
    check_cameras(path, seen_by, lines, cameras)
    values |= {name: np.full(len(lines), value) for name, value in UNSTATED.items() if name not in values}
    number_of = {name: number for number, name in enumerate(cameras)}
    camera = np.array([number_of[name] for name in seen_by.tolist()], dtype=np.int64)
    return header, _Table(path, lines, names, camera, values), len(texts[KEY]) - len(lines)


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
        one, other = csv_files.lines_of_rows(table.path, pair.tolist())
        raise ValueError(
            f"{table.path}, lines {one} and {other}: one ball must be seen once in a frame, or the scores must tell "
            "which candidate it is; they do not. Delete one of them."
        )
    return np.sort(order[np.append(True, ~same)]) if len(order) else order, int(same.sum())


def _sightings(table: _Table, rows: NDArray[np.int64], cameras: tuple[str, ...]) -> Sightings:
    values = {name: column[rows] for name, column in table.values.items()}
    pixels = np.column_stack((values["u"], values["v"]))
    return Sightings(cameras, table.camera[rows], values["t"], pixels, covariances(values))
