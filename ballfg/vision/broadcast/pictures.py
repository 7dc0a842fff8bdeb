"""Chooses and resizes the pictures of a video before its court is looked for, and reads candidates in them from a file.

Pictures that repeat the one before, as conversions of frame rates make them, are left out. Small ones are enlarged and
large ones reduced to a size of which lines and balls have the usual numbers of pixels. What is found there is given
back in the pixels of the video: pixels are squares, so a picture that is f times as wide has the pixel u at
f (u + 1/2) - 1/2.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.progress import Watch, unwatched
from ballfg.tracks import detections_file
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.motion import Frames, Motion, Shot
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

SMALLER: Final = 0.25  # of a picture that is compared
BLOCK: Final = 4  # of its pixels, whose mean is compared: compression changes single ones
SAME, SHARE = 3.0, 0.2
"""Grey levels, and share of the median, below which the largest change of a block is that of compression alone: it is
1.6 at most in a real video written again with doubled pictures, where the least real change is 35."""
UNEVEN: Final = 1
"""Pictures by which the distances of doubled ones differ, where they come from a conversion of the frame rate."""


@dataclass(frozen=True, eq=False)
class Kept:
    """The pictures of a video that do not repeat the one before.

    Attributes:
        frames: opens the video without the others.  numbers: (f,) of the kept pictures in the video.
        stamps: (n,) s, of all pictures, as the video has them.
    """

    frames: Frames
    numbers: Index
    stamps: Array

    @property
    def doubled(self) -> int:
        """Number of the others."""
        return len(self.stamps) - len(self.numbers)

    def places(self, pictures: Index) -> Index:
        """(p,) places among the kept ones of pictures (p,) of the video; -1 for the others."""
        after = np.clip(np.searchsorted(self.numbers, pictures), 0, len(self.numbers) - 1)
        return np.where(self.numbers[after] == pictures, after, -1)


def without_doubled(frames: Frames, count: int, watch: Watch = unwatched) -> Kept:
    """The pictures of a video without doubled ones, with even stamps if these come at even distances.

    Args: frames: opens the video.  count: of its pictures, about.
    """
    times, changes, last = list[float](), list[float](), None
    for stamp, image in watch(frames(), count, "pictures compared with the one before"):
        small = cv2.resize(image, None, fx=SMALLER, fy=SMALLER, interpolation=cv2.INTER_AREA)
        small = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.float32)
        if last is not None:
            change = np.abs(small - last)
            size = (max(change.shape[1] // BLOCK, 1), max(change.shape[0] // BLOCK, 1))
            changes.append(float(cv2.resize(change, size, interpolation=cv2.INTER_AREA).max()))
        times.append(stamp)
        last = small
    least = min(SAME, SHARE * float(np.median(changes))) if changes else 0.0
    repeats: Mask = np.append(False, np.array(changes) < least)
    numbers = np.flatnonzero(~repeats)
    if len(numbers) == len(times):
        return Kept(frames, numbers, np.array(times))
    stamps = _even(np.array(times), repeats)[numbers]

    def kept() -> Iterator[tuple[float, Image]]:
        place = iter(stamps.tolist())
        for again, (_, image) in zip(repeats.tolist(), frames(), strict=True):
            if not again:
                yield next(place), image

    return Kept(kept, numbers, np.array(times))


def _even(times: Array, repeats: Mask) -> Array:
    """(f,) s, stamps of all pictures: those between doubled ones were taken evenly, if these come at even distances."""
    apart = np.diff(np.flatnonzero(repeats))
    if len(apart) < 2 or np.ptp(apart) > UNEVEN:
        return times
    passed = np.cumsum(~repeats) - 1.0
    kept = np.flatnonzero(~repeats)
    rate = (times[kept[-1]] - times[kept[0]]) / max(passed[-1], 1.0)
    return np.asarray(times[kept[0]] + rate * passed)


WIDTHS: Final = (960, 1280)  # px, between which pictures are as they are
SPARE: Final = 40  # px of width, among which is one with a height that hardly needs rounding


@dataclass(frozen=True)
class Scale:
    """The size (width, height) px of a video's pictures and that in which they are searched."""

    video: tuple[int, int]
    searched: tuple[int, int]

    @classmethod
    def of(cls, video: tuple[int, int]) -> Scale:
        """The scale of a video's pictures."""
        width, height = video
        least, most = WIDTHS
        if least <= width <= most:
            return cls(video, video)
        widths = range(least, least + SPARE) if width < least else range(most, most - SPARE, -1)
        best = min(widths, key=lambda one: abs(height * one / width - round(height * one / width)))
        return cls(video, (best, round(height * best / width)))

    @property
    def factor(self) -> float:
        """By which a picture grows."""
        return self.searched[0] / self.video[0]

    def frames(self, frames: Frames) -> Frames:
        """The video whose pictures have the size that is searched."""
        if self.video == self.searched:
            return frames
        way = cv2.INTER_AREA if self.factor < 1.0 else cv2.INTER_CUBIC

        def resized() -> Iterator[tuple[float, Image]]:
            for stamp, image in frames():
                yield stamp, np.asarray(cv2.resize(image, self.searched, interpolation=way), dtype=np.uint8)

        return resized

    def to_searched(self, pixels: Array) -> Array:
        """(..., 2) px in searched pictures, of pixels (..., 2) of the video."""
        return (pixels + 0.5) * self.factor - 0.5

    def detections_searched(self, found: Detections) -> Detections:
        """Detections in the video, in searched pictures."""
        spread = found.covariances * self.factor**2
        pixels, streaks = self.to_searched(found.pixels), self.to_searched(found.streaks)
        return replace(found, pixels=pixels, streaks=streaks, covariances=spread)

    def detections_of_video(self, found: Detections) -> Detections:
        """Detections in searched pictures, in the video."""
        return self._back.detections_searched(found)

    def motion_of_video(self, motion: Motion) -> Motion:
        """A motion with cameras of the video's pictures."""
        return replace(motion, shots=tuple(self.shot_of_video(shot) for shot in motion.shots))

    def shot_of_video(self, shot: Shot) -> Shot:
        """A shot with cameras of the video's pictures."""

        def back(camera: Pinhole) -> Pinhole:
            return replace(camera, focal=camera.focal / self.factor, size=self.video)

        return replace(shot, cameras=tuple(back(camera) for camera in shot.cameras))

    def camera_of_video(self, camera: Camera) -> Camera:
        """A camera without distortion of searched pictures, as one of the video's."""
        matrix = camera.matrix / self.factor
        matrix[:2, 2] = self._back.to_searched(camera.matrix[:2, 2])
        matrix[2, 2] = 1.0
        return replace(camera, matrix=matrix, size=self.video)

    @property
    def _back(self) -> Scale:
        return Scale(self.searched, self.video)


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
