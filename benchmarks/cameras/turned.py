"""Tests whether the check of the cameras' agreement names a camera that was turned after its calibration."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from ballfg.benchmarks.cameras.scenes import Filmed
from ballfg.vision import Camera, associate, check_agreement

TURN: Final = 0.5  # Degrees
AXES: Final = {"right": 0, "down": 1, "forward": 2}  # Axes of a camera's frame that it is turned about


@dataclass(frozen=True)
class Turn:
    """One camera turned about one axis.

    Attributes:
        camera, axis: the turned camera and its axis.  named: the camera that the check names, None for none.
        found: degrees by which the check finds the camera turned; NaN where it finds nothing.
    """

    camera: str
    axis: str
    named: str | None
    found: float


def turns(filmed: Filmed) -> Iterator[Turn]:
    """Each camera turned about each axis in its declared calibration; the videos stay as they are."""
    cameras = filmed.recording.cameras
    for number, camera in enumerate(cameras):
        for axis, column in AXES.items():
            rig = [turned(c, column) if k == number else c for k, c in enumerate(cameras)]
            agreement = check_agreement(associate(filmed.detections, rig), rig)
            about = agreement.by_camera.get(camera.name)
            found = float("nan") if about is None else about.rotation
            yield Turn(camera.name, axis, agreement.culprit, found)


def turned(camera: Camera, axis: int) -> Camera:
    """The camera at the same place, turned by `TURN` about an axis of its own frame."""
    turn, _ = cv2.Rodrigues(np.radians(TURN) * np.eye(3)[axis])
    rotation = turn @ camera.rotation
    return replace(camera, rvec=cv2.Rodrigues(rotation)[0].ravel(), tvec=-rotation @ camera.centre)
