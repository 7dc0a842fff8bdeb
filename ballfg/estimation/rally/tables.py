"""Writes what a video of one moving camera shows: camera motion, events and strokes beside a dataset's files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.rally.moments import Event
from ballfg.estimation.rally.reconstruct import ShotRally
from ballfg.estimation.result import Estimate
from ballfg.files.whole_folder import whole_folder
from ballfg.tracks import TableWriter
from ballfg.tracks.detections_file import DETECTIONS_FILE, SCORE, seen_columns
from ballfg.tracks.info import INFO_FILE, DatasetInfo, write_info
from ballfg.tracks.rows import KEY
from ballfg.vision.broadcast.files import COURT, EVENTS, FILES, MOTION, STATES, STROKES
from ballfg.vision.broadcast.lines import moved
from ballfg.vision.broadcast.motion import Motion
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.camera_file import CAMERAS_FILE, write_cameras

POSE: Final = ("focal", "rx", "ry", "rz", "tx", "ty", "tz")
NOWHERE: Final = np.full(3, np.nan)
TINY: Final = 1e-6
"""Step of numerical derivatives, rad, m or a part of the focal length."""


def write_rally(
    folder: Path,
    info: DatasetInfo,
    motion: Motion,
    rallies: Sequence[ShotRally],
    events: Sequence[Event],
    strokes: Sequence[dict[str, Any]],
    court: str = "",
) -> list[str]:
    """Writes dataset.yaml, states.csv, detections.csv, cameras.yaml, camera_motion.csv, events.csv and strokes.csv.

    detections.csv holds the candidates where the fixed camera of their shot, in cameras.yaml, sees them.

    Args: rallies: of the motion's shots, in their order.  events, strokes: of all of them.
        court: text of the file that describes it; empty: table tennis.
    Returns: the names of the files.
    Raises: OSError: something cannot be written.
    """
    with whole_folder(folder, earlier=FILES) as stage:
        write_info(stage / INFO_FILE, info)
        write_cameras(stage / CAMERAS_FILE, [one.camera for one in rallies])
        _write_motion(stage / MOTION, motion)
        if court:
            (stage / COURT).write_text(court, encoding="utf-8")
        cuts = [Event("", float(motion.times[k]), "cut", NOWHERE, 0.0, NOWHERE, 1.0) for k in motion.cuts]
        with TableWriter(stage / EVENTS) as table:
            table.write(event_columns((*events, *cuts)))
        with TableWriter(stage / DETECTIONS_FILE) as table:
            moves = any(one.seen.shifts is not None for one in rallies)
            for one in rallies:
                names = np.full(len(one.seen), "", dtype=object)
                for stroke, estimate in zip(one.chosen.strokes, one.estimates, strict=True):
                    names[stroke.rows] = estimate.name
                own = one.seen
                shift = np.zeros((len(own), 3)) if moves and own.shift is None else own.shift
                seen = seen_columns(own.times, own.camera, own.pixels, own.covariances, shift=shift)
                table.write({KEY: names} | seen | {SCORE: own.scores})
        if strokes:
            with TableWriter(stage / STATES) as states:
                for estimate in (estimate for one in rallies for estimate in one.estimates):
                    states.write(state_columns(estimate))
            with TableWriter(stage / STROKES, plain=["end"]) as table:
                table.write({name: np.array([row[name] for row in strokes]) for name in strokes[0]})
        return [name for name in FILES if (stage / name).is_file()]


def _write_motion(path: Path, motion: Motion) -> None:
    """The cameras of all pictures of shots: `frame,t,camera,focal,rx,ry,rz,tx,ty,tz,k1` and sigmas (px, rad, m)."""
    with TableWriter(path) as table:
        for shot in motion.shots:
            numbers = np.arange(shot.first, shot.first + len(shot))
            values = np.array([_pose(camera) for camera in shot.cameras])
            sigmas = np.array([_sigmas(*pair) for pair in zip(shot.cameras, shot.covariances, strict=True)])
            in_video = numbers if motion.numbers is None else motion.numbers[numbers]
            columns: dict[str, Any] = {"frame": in_video, "t": motion.times[numbers], "camera": f"shot{shot.first}"}
            columns |= dict(zip(POSE, values.T, strict=True))
            columns["k1"] = np.array([camera.bend for camera in shot.cameras])
            table.write(columns | {f"sigma_{name}": column for name, column in zip(POSE, sigmas.T, strict=True)})


def _pose(camera: Pinhole) -> Array:
    """(7,) focal length px, rotation vector rad and translation m, OpenCV's."""
    rotation = np.asarray(cv2.Rodrigues(camera.turn)[0]).ravel()
    return np.concatenate(([camera.focal], rotation, -camera.turn @ camera.place))


def _sigmas(camera: Pinhole, covariance: Array) -> Array:
    """(7,) standard deviations of `_pose` for a covariance (7, 7) of turn, place and log focal length."""
    steps = TINY * np.eye(7)
    slope = np.stack([(_pose(moved(camera, d)) - _pose(moved(camera, -d))) / (2.0 * TINY) for d in steps], axis=1)
    return np.asarray(np.sqrt(np.diag(slope @ covariance @ slope.T)))


def event_columns(events: Sequence[Event]) -> dict[str, Any]:
    """The columns of events.csv: hits, bounces, where the ball was lost, cuts of the recording, in order of time."""
    rows = sorted(events, key=lambda event: event.t)
    places = np.array([event.place for event in rows]).reshape(-1, 3)
    sigmas = np.array([event.sigmas for event in rows]).reshape(-1, 3)
    return {
        KEY: np.array([event.trajectory for event in rows], dtype=object),
        "t": np.array([event.t for event in rows], dtype=np.float64),
        "kind": np.array([event.kind for event in rows], dtype=object),
        **dict(zip("xyz", places.T, strict=True)),
        "sigma_t": np.array([event.sigma_t for event in rows], dtype=np.float64),
        **dict(zip(("sigma_x", "sigma_y", "sigma_z"), sigmas.T, strict=True)),
        "probability": np.array([event.probability for event in rows], dtype=np.float64),
    }


def state_columns(estimate: Estimate) -> dict[str, Any]:
    """The columns of states.csv."""
    return {KEY: estimate.name, **estimate.columns, **estimate.correlations}
