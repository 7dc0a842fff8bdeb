"""Draws the overlay video: all views side by side with candidates, balls, trails and names.

The cameras are played back on one clock: each shows its frame that is nearest to the time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.progress import Watch, unwatched
from ballfg.vision.arrays import Image
from ballfg.vision.association.gathering import nearest
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections
from ballfg.vision.tracking.pipeline import Tracking
from ballfg.vision.tracking.view_painter import ViewPainter

VIEW_WIDTH: Final = 640  # px of one view: three side by side make 1920, the width of a screen
IN_A_ROW: Final = 3  # views side by side; more go below
PLAYED_AT: Final = 30.0  # Hz at which every frame is shown: slow motion for a camera of 120 Hz, smooth on any screen
HELD: Final = 0.1  # s that a frame stays on show: bridges dropped frames, and shows no ball that has long gone


@dataclass(frozen=True, eq=False)
class Schedule:
    """The frames on show at each time."""

    times: Array  # (k,) s, true time of each moment, increasing
    frames: Index  # (k, c) number of the frame of each camera; -1 where it has none within `HELD`


def write_overlay(
    path: Path, tracking: Tracking, streams: Sequence[Iterator[tuple[float, Image]]], watch: Watch = unwatched
) -> int:
    """Writes the overlay video (mp4).

    Args: path: a new file; its folder exists.  streams: the frames of each camera once more, from the first on.
        watch: sees the frames that are drawn.
    Returns: the number of its frames.
    Raises: OSError: the video cannot be written.
    """
    painter = OverlayPainter(tracking)
    moments = schedule(tracking.detections, tracking.cameras)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), PLAYED_AT, painter.size)
    if not video.isOpened():
        raise OSError(f"{path}: OpenCV cannot write this video. Check the disk, or go without the overlay.")
    try:
        for frame in watch(painter.paint_all(moments, streams), len(moments.times), "overlay frames drawn"):
            video.write(frame)
    finally:
        video.release()
    return len(moments.times)


class OverlayPainter:
    """Lays the views out and draws them. Attributes: size: width and height of the overlay, px."""

    def __init__(self, tracking: Tracking) -> None:
        self._views = [ViewPainter(tracking, i, VIEW_WIDTH) for i in range(len(tracking.cameras))]
        columns, height = min(IN_A_ROW, len(self._views)), max(view.size[1] for view in self._views)
        self._corners = [(i // columns * height, i % columns * VIEW_WIDTH) for i in range(len(self._views))]
        whole = self._corners[-1][0] + height
        self.size = (columns * VIEW_WIDTH, whole + whole % 2)  # the codec wants even sides

    def paint_all(self, moments: Schedule, streams: Sequence[Iterator[tuple[float, Image]]]) -> Iterator[Image]:
        """One picture a moment."""
        for time, frames, images in zip(moments.times, moments.frames, play(moments, streams), strict=True):
            page = np.zeros((self.size[1], self.size[0], 3), np.uint8)
            for view, (top, left), frame, image in zip(self._views, self._corners, frames, images, strict=True):
                painted = view.paint(image, int(frame), float(time))
                page[top : top + len(painted), left : left + VIEW_WIDTH] = painted
            yield page


def schedule(detections: Sequence[Detections], cameras: Sequence[Camera]) -> Schedule:
    """The times of a shown recording: the frames of the camera with most, and beyond them the others'."""
    clocks = [seen.frames - camera.time_offset for seen, camera in zip(detections, cameras, strict=True)]
    times = np.zeros(0)
    for clock in sorted(clocks, key=len, reverse=True):
        if len(times) == 0:
            times = clock
        elif len(clock):
            times = np.concatenate((clock[clock < times[0]], times, clock[clock > times[-1]]))
    return Schedule(times, np.column_stack([shown(clock, times) for clock in clocks]))


def shown(clock: Array, times: Array) -> Index:
    """(k,) index into `clock` (f,), increasing, of the stamp nearest to each of `times` (k,); -1 beyond `HELD`."""
    if len(clock) == 0:
        return np.full(len(times), -1, dtype=np.int64)
    index = nearest(clock, times)
    return np.where(np.abs(clock[index] - times) <= HELD, index, -1).astype(np.int64)


def play(moments: Schedule, streams: Sequence[Iterator[tuple[float, Image]]]) -> Iterator[list[Image | None]]:
    """Each moment's images, None without one; the streams begin with the cameras' first frames and run once."""
    at = [-1] * len(streams)
    images: list[Image | None] = [None] * len(streams)
    for frames in moments.frames:
        for i, wanted in enumerate(frames):
            while at[i] < wanted:
                _, images[i] = next(streams[i])
                at[i] += 1
        yield [image if frame >= 0 else None for image, frame in zip(images, frames, strict=True)]
