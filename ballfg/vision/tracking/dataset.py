"""Writes the tracking as a dataset with pictures, all files or none."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ballfg.files.whole_folder import check_replaceable, whole_folder
from ballfg.progress import Watch, unwatched
from ballfg.tracks import TableWriter, write_dataset
from ballfg.tracks.detections_file import DETECTIONS_FILE, EVENTS_FILE, SCORE, seen_columns
from ballfg.tracks.info import INFO_FILE, DatasetInfo, write_info
from ballfg.tracks.rows import KEY, SIGMAS, VALUES
from ballfg.vision.arrays import Image
from ballfg.vision.camera_file import CAMERAS_FILE, write_cameras
from ballfg.vision.tracking.contact_sheet import ContactSheet, Extent
from ballfg.vision.tracking.overlay import write_overlay
from ballfg.vision.tracking.pipeline import Tracking

Streams = Sequence[Callable[[], Iterator[tuple[float, Image]]]]
"""For each camera a function that opens its video and gives stamps (s) and images."""
TRACKS: Final = "tracks.csv"
OVERLAY: Final = "overlay.mp4"
SHEET: Final = "contact_sheet.png"
STATES: Final = "states.csv"
FILES: Final = (INFO_FILE, TRACKS, STATES, EVENTS_FILE, DETECTIONS_FILE, CAMERAS_FILE, OVERLAY, SHEET)  # all written


def check_result_folder(folder: Path, inputs: Sequence[Path], *, force: bool, files: Sequence[str] = FILES) -> None:
    """Refuses a folder in which content would be lost.

    Args: folder: for the dataset.  inputs: files that are read.  force: an earlier result may be replaced.
        files: names that an earlier result may have.
    Raises: ValueError: a file; an input that lies in it; other files; an earlier result and no `force`.
        FileNotFoundError: its parent does not exist.
    """
    for path in inputs:
        if path.resolve().parent == folder.resolve():
            raise ValueError(f"out must not hold what is read; {path} lies in {folder}. Choose another folder.")
    check_replaceable(folder, mark=INFO_FILE, what="an earlier result", only=files, force=force)


def write_tracking(
    folder: Path,
    tracking: Tracking,
    info: DatasetInfo,
    *,
    table: Extent | None = None,
    streams: Streams | None = None,
    tables: Mapping[str, Sequence[Mapping[str, Any]]] | None = None,
    overlay: bool = True,
    watch: Watch = unwatched,
) -> list[str]:
    """Writes dataset.yaml, tracks.csv, detections.csv, cameras.yaml, contact_sheet.png and overlay.mp4.

    A recording without a ball gives a tracks.csv without rows. The files are written in a hidden folder and moved to
    their names when all are complete.

    Args:
        folder: as `check_result_folder` allows.
        info: the content of dataset.yaml.
        table: (x_low, x_high, y_low, y_high) m, drawn in the contact sheet; None where it is not known.
        streams: the videos; None where there are none: then there is no overlay, and the sheet has no pictures.
        tables: name of a file -> parts of its table, columns (n,) each, which take the place of tracks.csv: the depth
            of points that one camera saw is no measurement.
        watch: sees the frames of the overlay that are drawn.
    Returns: the names of the files.
    Raises: OSError: something cannot be written. ValueError: a track that breaks a rule of datasets.
    """
    with whole_folder(folder, earlier=FILES) as stage:
        if tables is not None:
            write_info(stage / INFO_FILE, info)
            for name, parts in tables.items():
                with TableWriter(stage / name) as writer:
                    for part in parts:
                        writer.write(part)
        elif tracking.balls:
            write_dataset(stage, info, tracking.tracks)
        else:
            write_info(stage / INFO_FILE, info)
            with TableWriter(stage / TRACKS) as empty:
                empty.write({KEY: np.zeros(0, dtype=object)} | {name: np.zeros(0) for name in (*VALUES, *SIGMAS)})
        write_cameras(stage / CAMERAS_FILE, tracking.cameras)
        with TableWriter(stage / DETECTIONS_FILE) as detections:
            exposed = any(camera.exposure > 0.0 for camera in tracking.cameras)  # else a streak says nothing
            sized = any(ball.sightings.radii is not None for ball in tracking.balls)
            for camera, seen in enumerate(tracking.detections):
                names = np.full(len(seen), "", dtype=object)  # of the balls; candidates of no ball have none
                for name, ball in zip(tracking.names, tracking.balls, strict=True):
                    names[tracking.rows(ball, camera)] = name
                own = (seen.times, seen.camera, seen.pixels, seen.covariances)
                cues = (seen.streaks if exposed else None, seen.shift, seen.radii if sized else None)
                columns = seen_columns(*own, *cues)
                detections.write({KEY: names} | columns | {SCORE: seen.scores})
        sheet = ContactSheet(tracking, info.table_height, table)
        passing = [sheet.passing(camera, opened()) for camera, opened in enumerate(streams or ())]
        if passing and overlay:
            write_overlay(stage / OVERLAY, tracking, passing, watch, info.table_height)
        for camera, frames in enumerate(passing if not overlay else ()):
            for _ in itertools.islice(frames, sheet.last(camera) + 1):
                pass
        sheet.write(stage / SHEET)
        return [name for name in FILES if (stage / name).is_file()]
