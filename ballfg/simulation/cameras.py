"""Makes a rig of cameras over a table-tennis table, for synthetic scenes."""

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ballfg.checks import shown
from ballfg.dynamics.surfaces import TABLE_ABOVE_FLOOR, TABLE_LENGTH
from ballfg.vision.camera import Camera

FOCAL_BY_WIDTH: Final = 0.78125  # Focal length over the image's width: 1000 px at 1280, 65 degrees from side to side
TARGET: Final = (TABLE_LENGTH / 2, 0.0, TABLE_ABOVE_FLOOR + 0.2)
"""m, target of the rig: the middle of the flights, 0.2 m over the middle of the table."""
_UP: Final = (0.0, 0.0, 1.0)

_PLACES: Final = {"left": (116.0, 18.0), "right": (-98.0, 27.0), "far": (64.0, 23.0)}
"""Degrees: azimuth about the vertical from +x, and elevation, of each camera as seen from the target. No two are
opposite, the three have different heights, and each sees all four corners of the table from 3 m."""
_LENSES: Final = {
    "left": (-0.16, 0.06, 0.0006, -0.0004, 0.0),
    "right": (-0.11, 0.03, -0.0005, 0.0007, 0.0),
    "far": (-0.20, 0.09, 0.0003, 0.0005, 0.0),
}
"""k1, k2, p1, p2, k3 of each lens: barrels that move the corners inwards by 35 to 65 px at 1280x720."""
_OFF_CENTRE: Final = {"left": (0.006, -0.004), "right": (-0.005, 0.007), "far": (0.003, 0.005)}
"""Offset of the principal point from the middle of the image, as a share of its width."""


def table_rig(size: tuple[int, int] = (1280, 720), distance: float = 3.0) -> list[Camera]:
    """Three cameras around a table as in `ballfg.simulation`, with a view of the launcher's balls.

    The cameras differ in height, direction, lens and principal point; focal lengths are proportional to the image's
    width, so that a smaller rig has the same view.

    Args:
        size: width and height of the images, px.
        distance: m from each camera to the middle of the flights.
    Returns: cameras `left` and `right` of the launcher's way, and `far` on the left of the other end.
    Raises: ValueError: a size or distance that is not positive.
    """
    if not 0.0 < distance < np.inf:
        raise ValueError(f"distance must be positive and finite; got {distance} m. Give metres, for instance 3.")
    cameras = []
    for name, (azimuth, elevation) in _PLACES.items():
        turn, rise = np.deg2rad((azimuth, elevation))
        towards = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        centre, (right, down) = np.array(TARGET) + distance * towards, _OFF_CENTRE[name]
        off_centre = (right * size[0], down * size[0])
        cameras.append(looking_at(name, centre, TARGET, FOCAL_BY_WIDTH * size[0], size, _LENSES[name], off_centre))
    return cameras


def looking_at(
    name: str,
    centre: ArrayLike,
    target: ArrayLike,
    focal: float,
    size: tuple[int, int],
    distortion: Sequence[float] = (),
    off_centre: tuple[float, float] = (0.0, 0.0),
) -> Camera:
    """A camera at one point, directed at another and level.

    Args:
        centre: (3,) m, its place.  target: (3,) m, the point at the principal point.  focal: px.
        size: width and height of the image, px.  distortion: in OpenCV's order.
        off_centre: px, from the middle of the image to the principal point.
    Raises: ValueError: centre and target on a vertical line, or arguments that `Camera` refuses.
    """
    forward = np.asarray(target, dtype=np.float64) - np.asarray(centre, dtype=np.float64)
    right = np.cross(forward, _UP)
    if not np.linalg.norm(right) > 0.0:
        raise ValueError(
            f"camera {shown(name)}: centre must not stand over or under target; they differ by {forward.tolist()} m. "
            "Move one of them sideways a little."
        )
    rows = np.stack((right, np.cross(forward, right), forward))
    rotation = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    middle = [(side - 1) / 2 + shift for side, shift in zip(size, off_centre, strict=True)]
    return Camera(
        name=name,
        size=size,
        matrix=np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]]),
        distortion=np.array(distortion, dtype=np.float64),
        rvec=np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64).reshape(3),
        tvec=-rotation @ np.asarray(centre, dtype=np.float64),
    )
