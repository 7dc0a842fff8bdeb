"""Reads candidates from a table `detections.csv`, of any detector, as a recording of each camera."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.checks import shown
from ballfg.tracks import detections_file
from ballfg.tracks.checks import check_step
from ballfg.tracks.rows import KEY
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

REQUIRED: Final = ("t", detections_file.CAMERA, "u", "v")
UNUSED: Final = (KEY,)  # columns that may be there and are not needed: which ball a row belongs to is found anew
SURE: Final = 1.0  # score of all rows of a table without one: somebody has chosen them
_UNSTATED: Final = detections_file.UNSTATED | {detections_file.SCORE: SURE}
_RULES: Final = {**detections_file.RULES, detections_file.SCORE: ("0 to 1", lambda x: (x >= 0.0) & (x <= 1.0))}


def read_detections(
    path: Path, cameras: Sequence[Camera], ignored: Sequence[str] = ()
) -> tuple[list[Detections], list[str]]:
    """The candidates of each camera.

    A camera's frames are the stamps at which it has a row: rows at one stamp are candidates of one frame. The order of
    rows is free.

    Args:
        path: `t` (s, as the camera writes it), `camera`, `u`, `v` (px), optionally `sigma_u`, `sigma_v` (px), `rho_uv`
            and `score`.
        ignored: names of cameras whose rows are passed over.
    Returns: detections in the order of the cameras, and what was ignored, one sentence each.
    Raises: FileNotFoundError: there is no such file. ValueError: a column that is missing, a cell out of its range, an
        unknown camera, a camera without rows; the message names file, line and column.
    """
    header, texts, values = detections_file.read_columns(path, REQUIRED)
    names = texts[detections_file.CAMERA]
    rows = np.arange(len(names))
    detections_file.check_values(path, values, rows, _RULES)
    detections_file.check_cameras(path, names, rows, [camera.name for camera in cameras], ignored)
    blind = [camera.name for camera in cameras if not (names == camera.name).any()]
    if blind:
        problem = f"{path}: every camera must have rows; got none of {' and '.join(map(repr, blind))}"
        raise ValueError(f"{problem}. Add them, or leave the camera out with --without {blind[0]}.")
    values |= {name: np.full(len(names), value) for name, value in _UNSTATED.items() if name not in values}
    known = (*REQUIRED, *detections_file.OPTIONAL, *UNUSED)
    notes = [f"{path.name}: column {shown(name)} ignored" for name in header if name not in known]
    number = np.unique(names, return_inverse=True)[1]
    kept = np.sort(np.unique(np.column_stack((number, *values.values())), axis=0, return_index=True)[1])
    if len(kept) < len(names):
        notes.append(f"{path.name}: {len(names) - len(kept)} exact repeats of rows dropped")
    names, values = names[kept], {name: column[kept] for name, column in values.items()}
    found = []
    for camera in cameras:
        mine = {column: numbers[names == camera.name] for column, numbers in values.items()}
        frames, frame = np.unique(mine["t"], return_inverse=True)
        detections_file.check_inside(path, camera.name, camera.size, np.column_stack((mine["u"], mine["v"])))
        order = np.argsort(frame, kind="stable")
        pixels, streaks = np.column_stack((mine["u"], mine["v"])), np.full((len(order), 2, 2), np.nan)
        spread, scores = detections_file.covariances(mine)[order], mine[detections_file.SCORE][order]
        found.append(Detections(camera.name, frames, frame[order], pixels[order], spread, scores, streaks))
        check_step(f"{path}, camera {shown(camera.name)}", frames)
    return found, notes
