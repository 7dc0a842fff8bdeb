"""Candidates from a table: `detections.csv`, of a detector of any kind, as a recording of each camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from ballfg.checks import did_you_mean
from ballfg.tracks import csv_errors
from ballfg.tracks.checks import check_step
from ballfg.tracks.detections_file import CAMERA, NOISE, RULES, SCORE, UNSTATED, check_header, check_values, place
from ballfg.tracks.rows import KEY
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

Array = NDArray[np.float64]

REQUIRED: Final = ("t", CAMERA, "u", "v")
OPTIONAL: Final = (*NOISE, SCORE)
UNUSED: Final = (KEY,)
"""Columns that may be there and are not needed: which ball a row belongs to is found anew."""
SURE: Final = 1.0
"""Score of all rows of a table without one: somebody has chosen them."""
_RULES: Final = {**RULES, SCORE: ("0 to 1", lambda x: (x >= 0.0) & (x <= 1.0))}


def read_detections(
    path: Path, cameras: Sequence[Camera], ignored: Sequence[str] = ()
) -> tuple[list[Detections], list[str]]:
    """The candidates of each camera.

    A camera's frames are the stamps at which it has a row: rows at one stamp are candidates of one frame. The order of
    rows is free.

    Args:
        path: `t` (s, as the camera writes it), `camera`, `u`, `v` (px), optionally `sigma_u`, `sigma_v` (px), `rho_uv`
            and `score`.
        cameras: of the rig.
        ignored: names of cameras whose rows are passed over.
    Returns: detections in the order of the cameras, and what was ignored, one sentence each.
    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a column that is missing, a cell out of its range, an unknown camera, a camera without rows; the
            message names file, line and column.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a table of detections; there is none. Correct the path.")
    header = csv_errors.read_header(path)
    check_header(path, header, REQUIRED, (*REQUIRED, *OPTIONAL))
    names, values = _read(path, [name for name in header if name in (*REQUIRED, *OPTIONAL)])
    check_values(path, values, np.arange(len(names)), _RULES)
    _check_cameras(path, names, cameras, ignored)
    known = (*REQUIRED, *OPTIONAL, *UNUSED)
    notes = [f"{path.name}: column {name!r} ignored" for name in header if name not in known]
    names, values, repeats = _once(names, values)
    if repeats:
        notes.append(f"{path.name}: {repeats} exact repeats of rows dropped")
    found = [_of_camera(camera.name, names == camera.name, values) for camera in cameras]
    for seen in found:
        check_step(f"{path}, camera {seen.camera!r}", seen.frames)
    return found, notes


def _read(path: Path, columns: Sequence[str]) -> tuple[NDArray[np.str_], dict[str, Array]]:
    """(n,) names of the cameras, and the numbers (n,) of each other column."""
    numeric = [name for name in columns if name != CAMERA]
    convert = pa_csv.ConvertOptions(
        column_types={CAMERA: pa.string(), **dict.fromkeys(numeric, pa.float64())},
        include_columns=list(columns),
        null_values=[],
    )
    try:
        table = pa_csv.read_csv(path, pa_csv.ReadOptions(use_threads=False), convert_options=convert)
    except pa.ArrowInvalid as error:
        raise csv_errors.explain(path, numeric, str(error)) from None
    values = {name: np.asarray(table.column(name).to_numpy(), dtype=np.float64) for name in numeric}
    unstated = UNSTATED | {SCORE: SURE}
    values |= {name: np.full(table.num_rows, value) for name, value in unstated.items() if name not in values}
    return np.array(table.column(CAMERA).to_pylist(), dtype=np.str_), values


def _once(names: NDArray[np.str_], values: dict[str, Array]) -> tuple[NDArray[np.str_], dict[str, Array], int]:
    """The table without rows that stand in it before, and how many those were."""
    _, number = np.unique(names, return_inverse=True)
    _, first = np.unique(np.column_stack((number, *values.values())), axis=0, return_index=True)
    kept = np.sort(first)
    return names[kept], {name: column[kept] for name, column in values.items()}, len(names) - len(kept)


def _check_cameras(path: Path, names: NDArray[np.str_], cameras: Sequence[Camera], ignored: Sequence[str]) -> None:
    known = [camera.name for camera in cameras]
    strange = ~np.isin(names, [*known, *ignored])
    if strange.any():
        row = int(np.argmax(strange))
        raise ValueError(
            f"{place(path, np.array([row]), CAMERA)} must be a camera: {', '.join(known)}; got {str(names[row])!r}. "
            f"Rename it, add it to the cameras' file, or delete its rows.{did_you_mean(str(names[row]), known)}"
        )
    blind = [name for name in known if not (names == name).any()]
    if blind:
        raise ValueError(
            f"{path}: every camera must have rows; got none of {' and '.join(map(repr, blind))}. "
            f"Add them, or leave the camera out with --without {blind[0]}."
        )


def _of_camera(name: str, rows: NDArray[np.bool_], values: dict[str, Array]) -> Detections:
    mine = {column: numbers[rows] for column, numbers in values.items()}
    frames, frame = np.unique(mine["t"], return_inverse=True)
    order = np.argsort(frame, kind="stable")
    across = mine["rho_uv"] * mine["sigma_u"] * mine["sigma_v"]
    covariances = np.stack((mine["sigma_u"] ** 2, across, across, mine["sigma_v"] ** 2), axis=-1).reshape(-1, 2, 2)
    pixels = np.column_stack((mine["u"], mine["v"]))
    streaks = np.full((len(order), 2, 2), np.nan)
    return Detections(name, frames, frame[order], pixels[order], covariances[order], mine["score"][order], streaks)
