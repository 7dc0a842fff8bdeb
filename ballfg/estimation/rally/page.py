"""Builds the page of a rally: its video with the reprojected flights beside the table, on one time line."""

import base64
import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.rally.tables import POSE
from ballfg.pages.html import Html, items, own, section, tag, whole_page
from ballfg.state import STANDARD_GRAVITY
from ballfg.tracks import csv_files
from ballfg.tracks.detections_file import DETECTIONS_FILE
from ballfg.tracks.info import INFO_FILE, read_info
from ballfg.vision.broadcast.court import TABLE_TENNIS, read_court
from ballfg.vision.broadcast.files import COURT, EVENTS, MOTION, STATES, STROKES, TRACKED, VIDEOS
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.camera_file import CAMERAS_FILE, read_cameras

SMALL: Final = 8 * 2**20
"""Bytes of a video, at most, that goes into the page; a larger one is linked, relative to the page."""
STEP: Final = 0.005
"""s between drawn points of a flight."""
LONGEST: Final = 0.5
"""s to the next hit, up to which a flight is drawn beyond its last sample."""
DRAWN: Final = 20
"""Candidates of a picture that are drawn, those with the highest scores."""

Rows = list[dict[str, Any]]


def rally_page(folder: Path, video: Path | None, out: Path) -> tuple[str, list[str]]:
    """The text of the page of a rally, and sentences on what it lacks.

    Args: folder: of `ballfg track`.  video: the file it was found in; None: looked for by its name.  out: of the page.
    Raises: FileNotFoundError: the video does not exist. ValueError: a table of the folder that cannot be read.
    """
    info, _ = read_info(folder / INFO_FILE)
    motion, events, strokes, states = (_read(folder / name) for name in (MOTION, EVENTS, STROKES, STATES))
    cameras = {one.name: one for one in read_cameras(folder / CAMERAS_FILE)}
    size = next(iter(cameras.values())).size
    ground = read_court(str(folder / COURT) if (folder / COURT).is_file() else TABLE_TENNIS)
    x, y = ground.size.tolist()
    source, notes = _video(folder, info.source or "", video, out)
    data = {
        "size": size,
        "frames": [_camera_row(row) for row in motion],
        "candidates": _candidates(folder / DETECTIONS_FILE, motion, cameras),
        "table": {
            "extent": [-x, x, -y, y],
            "height": 0.0,
            "net": [ground.net, ground.net_reach] if ground.net else None,
            "lines": ground.lines.tolist(),
            "floor": ground.floor,
        },
        "strokes": [_stroke(row, states, events) for row in strokes],
        "events": [{key: _plain(value) for key, value in row.items()} for row in events],
    }
    page = whole_page(
        f"{info.name}: rally",
        tag("h1", f"{info.name}: {len(strokes)} strokes"),
        Html(own("rally.html").replace("VIDEO", source)),
        section("Notes", items(notes)),
        style=own("show.css") + own("rally.css"),
        data=data,
        scripts=(own("rally.js"),),
    )
    return page, notes


def _video(folder: Path, source: str, given: Path | None, out: Path) -> tuple[str, list[str]]:
    """The address of the video for a page, and a note if it is not inside."""
    if given is not None and not given.is_file():
        raise FileNotFoundError(f"{given} does not exist; it could be the video of {folder}. Check the path.")
    name = Path(source.removeprefix(TRACKED)).name  # it may have spaces
    places = [given] if given is not None else [at / name for at in (folder, folder.absolute().parent, Path())]
    found = next((one for one in places if name and one.is_file() and one.suffix.lower() in VIDEOS), None)
    if found is None:
        return "", [
            f"The video {name or 'of the rally'} was not found. Name it: ballfg show {folder} VIDEO --out {out}"
        ]
    if found.stat().st_size <= SMALL:
        return f"data:video/mp4;base64,{base64.b64encode(found.read_bytes()).decode('ascii')}", []
    link = os.path.relpath(found.absolute(), out.absolute().parent).replace(os.sep, "/")
    return quote(link), [f"The video has more than {SMALL // 2**20} MB: the page links to {link}."]


def _read(path: Path) -> Rows:
    """The rows of a table, numbers as such; none if there is no such file."""
    if not path.is_file():
        return []
    names = [name.strip() for name in csv_files.read_header(path)]
    rows = (dict(zip(names, (cell.strip() for cell in cells), strict=False)) for _, cells in csv_files.records(path))
    texts = {"trajectory", "stroke", "camera", "kind", "end", "status", "label", "quality"}
    return [{key: cell if key in texts else _number(path, key, cell) for key, cell in row.items()} for row in rows]


def _number(path: Path, name: str, cell: str) -> float:
    if cell in ("", "nan"):
        return np.nan
    if not csv_files.is_number(cell):
        raise ValueError(f"{path}: {name} must be a number in each row; got {cell!r}. Track the video again.")
    return float(cell)


def _plain(value: Any) -> Any:
    """A cell as JSON: an unknown number is null."""
    if not isinstance(value, float):
        return value
    return round(value, 5) if np.isfinite(value) else None


def _camera_row(row: Mapping[str, Any]) -> list[float]:
    """Stamp s, focal length px, the rotation by rows, translation m, k1: what a script needs to project."""
    turn = np.asarray(cv2.Rodrigues(np.array([row[name] for name in POSE[1:4]]))[0]).ravel()
    values = [row["t"], row["focal"], *turn, *(row[name] for name in POSE[4:]), row["k1"]]
    return [float(f"{value:.7g}") for value in values]


def _candidates(path: Path, motion: Rows, cameras: Mapping[str, Any]) -> list[list[list[float]]]:
    """u, v px in the picture itself, score, and whether a flight has it, of each picture's likeliest candidates."""
    by_frame = dict[tuple[str, float], Rows]()
    for row in _read(path):
        by_frame.setdefault((row["camera"], round(row["t"], 4)), []).append(row)
    found = list[list[list[float]]]()
    for picture in motion:
        here = by_frame.get((picture["camera"], round(picture["t"], 4)), [])
        here = sorted(here, key=lambda row: (row["trajectory"] == "", -row["score"]))[:DRAWN]
        seen = cameras[picture["camera"]]
        fixed = Pinhole(seen.rotation, seen.centre, float(seen.matrix[0, 0]), seen.size)
        values = _camera_row(picture)
        turn = np.reshape(values[2:11], (3, 3))
        own = Pinhole(turn, -turn.T @ np.array(values[11:14]), values[1], seen.size, values[14])
        pixels = fixed.onto(np.array([(row["u"], row["v"]) for row in here]).reshape(-1, 2), own)
        places = np.round(pixels, 1).tolist()
        found.append([[*at, row["score"], row["trajectory"] != ""] for at, row in zip(places, here, strict=True)])
    return found


def _stroke(row: Mapping[str, Any], states: Rows, events: Rows) -> dict[str, Any]:
    """The numbers of a stroke, its path [t, x, y, z], and times and covariances of its samples."""
    name = row["stroke"]
    mine = [state for state in states if state["trajectory"] == name]
    following = [event["t"] for event in events if event["kind"] == "hit" and event["t"] > mine[-1]["t"]]
    knots = [_knot(state, moves=True) for state in mine]
    begin, end = row["t_start"], min([*following, knots[-1][0] + LONGEST])
    knots = [_carried(knots[0], begin), *knots, *([_carried(knots[-1], end)] if following[:1] == [end] else [])]
    knots += [_knot(one, moves=False) for one in events if one["trajectory"] == name and one["kind"] == "bounce"]
    knots.sort(key=lambda knot: knot[0])
    path = [point for pair in pairwise(knots) for point in between(*pair)]
    return {
        **{key: _plain(value) for key, value in row.items()},
        "path": np.round(path, 4).tolist(),
        "samples": [[round(value, 6) for value in _covariance(state)] for state in mine],
    }


Knot = tuple[float, Array, Array | None]
"""Time s, place (3,) m, and velocity (3,) m/s or None."""


def _knot(row: Mapping[str, Any], *, moves: bool) -> Knot:
    place = np.array([row[axis] for axis in "xyz"])
    return row["t"], place, np.array([row[f"v{axis}"] for axis in "xyz"]) if moves else None


def _carried(knot: Knot, t: float) -> Knot:
    """A knot with a velocity in free fall to another time, s."""
    begin, place, velocity = knot
    assert velocity is not None
    dt, fall = t - begin, np.array([0.0, 0.0, STANDARD_GRAVITY])
    return t, place + velocity * dt - 0.5 * fall * dt**2, None


def between(before: Knot, after: Knot) -> list[list[float]]:
    """Points [t, x, y, z] of a path between two knots, the first included: by Hermite where both velocities are known.

    A knot without velocity (a bounce, a hit) is a corner: there the parabola of the other one ends.
    """
    (t, start, first), (end, place, second) = before, after
    dt = max(end - t, 1e-6)
    s = np.arange(0.0, dt, STEP)[:, None]
    if first is not None and second is not None:
        u = s / dt
        points = start * (1 + 2 * u) * (1 - u) ** 2 + place * u**2 * (3 - 2 * u)
        points += dt * (first * u * (1 - u) ** 2 - second * u**2 * (1 - u))
    elif second is not None:
        points = place + second * (s - dt) + (start - place + second * dt) * ((s - dt) / dt) ** 2
    else:
        speed = (place - start) / dt if first is None else first
        points = start + speed * s + (place - start - speed * dt) * (s / dt) ** 2
    return np.column_stack((t + s, points)).tolist()


def _covariance(state: Mapping[str, Any]) -> Sequence[float]:
    """Time s, and the covariance xx, xy, xz, yy, yz, zz m^2 of a position."""
    x, y, z = (state[f"sigma_{axis}"] for axis in "xyz")
    xy, xz, yz = (state.get(f"rho_{pair}", 0.0) for pair in ("xy", "xz", "yz"))
    return state["t"], x * x, xy * x * y, xz * x * z, y * y, yz * y * z, z * z
