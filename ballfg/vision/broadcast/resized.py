"""Enlarges small pictures and reduces large ones to a size of which lines and balls have the usual numbers of pixels.

What is found there is given back in the pixels of the video: pixels are squares, so a picture that is f times as wide
has the pixel u at f (u + 1/2) - 1/2.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.motion import Frames, Motion, Shot
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

WIDTHS: Final = (960, 1280)
"""px, between which pictures are as they are."""
SPARE: Final = 40
"""px of width, among which is one with a height that hardly needs rounding."""


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
