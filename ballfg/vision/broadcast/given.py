"""Reads what a user gives for a video of a moving camera: the court's corners, and candidates of another detector."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.tracks import csv_files, detections_file
from ballfg.vision.broadcast.doubled import Kept
from ballfg.vision.broadcast.motion import Shot
from ballfg.vision.detection.detections import Detections

CORNERS: Final = 4


def read_corners(path: Path) -> dict[int, Array]:
    """Corners of the court (4, 2) px in some pictures, in any order.

    Args: path: a table `frame,u,v` with four rows for each of its pictures, counted from 0.
    Raises: FileNotFoundError. ValueError: a column that is missing, a cell that is no number, a picture without four
        corners; the message names the file and the picture.
    """
    if not path.is_file():
        raise FileNotFoundError(f"--corners {path} does not exist. Check the path.")
    names = [name.strip() for name in csv_files.read_header(path)]
    if not {"frame", "u", "v"} <= set(names):
        raise ValueError(f"{path} must have the columns frame, u, v; got {', '.join(names)}. Name them in line 1.")
    found = dict[int, list[tuple[float, float]]]()
    for line, cells in csv_files.records(path):
        row = dict(zip(names, (cell.strip() for cell in cells), strict=False))
        if not all(csv_files.is_number(row.get(name, "")) for name in ("frame", "u", "v")):
            raise ValueError(f"{path}, line {line}: frame, u and v must be numbers. Correct it.")
        if float(row["frame"]) % 1.0 != 0.0:
            raise ValueError(
                f"{path}, line {line}: frame must be a picture's number, from 0 on; got {row['frame']}. Correct it."
            )
        found.setdefault(int(float(row["frame"])), []).append((float(row["u"]), float(row["v"])))
    for frame, points in found.items():
        if len(points) != CORNERS:
            raise ValueError(f"{path}: picture {frame} must have {CORNERS} corners; got {len(points)}. Correct it.")
    return {frame: np.array(points) for frame, points in found.items()}


def read_candidates(path: Path, shot: Shot, times: Array, kept: Kept) -> Detections:
    """The candidates of another detector in the pictures of a shot.

    Args:
        path: a table with `t` (s), `u`, `v` (px of the video), optionally `sigma_u`, `sigma_v`, `rho_uv`, `score`;
            several rows a picture. A row belongs to the picture with the nearest stamp of the video; those of pictures
            that repeat the one before are left out.
        times: (f,) s, of the kept pictures: where others are left out, not always the stamps of the video.
        kept: these pictures.
    Raises: FileNotFoundError: there is no such file. ValueError: a column that is missing, a cell out of its range, a
        stamp before or after the video.
    """
    _, _, values = detections_file.read_candidates(path, ("t", "u", "v"))
    stamps, t = kept.stamps, values["t"]
    step = float(np.median(np.diff(stamps)))
    outside = np.flatnonzero((t < stamps[0] - step) | (t > stamps[-1] + step))
    if len(outside):
        raise ValueError(
            f"{path}, row {outside[0] + 1}: t must be the stamp of a picture of the video, {stamps[0]:g} to "
            f"{stamps[-1]:g} s; got {t[outside[0]]:g}. Give t in seconds on the video's clock."
        )
    frame = kept.places(np.searchsorted(0.5 * (stamps[1:] + stamps[:-1]), t)) - shot.first
    rows = np.flatnonzero((frame >= 0) & (frame < len(shot)))
    rows = rows[np.argsort(frame[rows], kind="stable")]
    pixels = np.column_stack((values["u"], values["v"]))[rows]
    spread, scores = detections_file.covariances(values)[rows], values[detections_file.SCORE][rows]
    streaks = np.full((len(rows), 2, 2), np.nan)
    mine = times[shot.first : shot.first + len(shot)]
    return Detections("main", mine, frame[rows], pixels, spread, scores, streaks)
