"""A camera that was nudged after its calibration: is it named?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from ballfg.benchmarks.cameras.scenes import Filmed
from ballfg.vision import Camera, associate, check_agreement

TURN: Final = 0.5
"""Degrees."""
AXES: Final = {"right": 0, "down": 1, "forward": 2}
"""Axes of a camera's frame that it is turned about."""


@dataclass(frozen=True)
class Nudge:
    """One camera turned about one axis.

    Attributes:
        camera, axis: which.
        named: the camera that the check names, None for none.
        turn: degrees by which the check says that the nudged camera is turned; NaN where it says nothing.
        balls: found in spite of it.
    """

    camera: str
    axis: str
    named: str | None
    turn: float
    balls: int


def nudges(filmed: Filmed) -> Iterator[Nudge]:
    """Each camera turned about each axis in its declared calibration; the videos stay what they are."""
    cameras = filmed.recording.cameras
    for number, camera in enumerate(cameras):
        for axis, column in AXES.items():
            rig = [turned(c, column) if k == number else c for k, c in enumerate(cameras)]
            balls = associate(filmed.detections, rig)
            said = check_agreement(balls, rig)
            about = said.by_camera.get(camera.name)
            turn = float("nan") if about is None else about.rotation
            yield Nudge(camera.name, axis, said.culprit, turn, len(balls))


def turned(camera: Camera, axis: int) -> Camera:
    """The camera as if it stood where it stands and were turned by `TURN` about an axis of its own frame."""
    turn, _ = cv2.Rodrigues(np.radians(TURN) * np.eye(3)[axis])
    rotation = turn @ camera.rotation
    return replace(camera, rvec=cv2.Rodrigues(rotation)[0].ravel(), tvec=-rotation @ camera.centre)
