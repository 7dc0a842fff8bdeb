"""Small changes of a camera: its turn, its move and the growth of its focal length, as seven numbers.

A camera with a covariance is uncertain by such a change. A point X is seen by the changed camera where the camera as it
is sees X' = C + p + p x turn, p = X - C - move, with the centre C; pixels then grow about the principal point by
exp(zoom). The turn is of first order in X', exact in `changed`.
"""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array
from ballfg.vision.camera import Camera
from ballfg.vision.projection import CameraBank

CHANGES: Final = 7
"""Three rad about the world's axes, three m of the centre, the logarithm of the ratio of focal lengths."""
TURN, MOVE, ZOOM = slice(0, 3), slice(3, 6), 6


def changed(camera: Camera, change: Array) -> Camera:
    """The camera after a change (7,); its covariance stays."""
    import cv2  # a dataset without cameras needs none of it

    turned = camera.rotation @ cv2.Rodrigues(-change[TURN])[0]
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= np.exp(change[ZOOM])
    centre = camera.centre + change[MOVE]
    rvec = np.asarray(cv2.Rodrigues(turned)[0], dtype=np.float64)
    return replace(camera, matrix=matrix, rvec=rvec, tvec=-turned @ centre)


def seen_at(points: Tensor, centre: Tensor, change: Tensor) -> Tensor:
    """(n, 3) m, X' of points (n, 3) m for cameras at (n, 3) m after changes (n, 7)."""
    away = points - centre - change[:, MOVE]
    return centre + away + torch.linalg.cross(away, change[:, TURN])


def slopes_of(points: Array, centre: Array, change: Array) -> tuple[Array, Array, Array]:
    """`seen_at` (n, 3) m, and its derivatives by the points (n, 3, 3), and by turn and move (n, 3, 6)."""
    by_point, away = np.eye(3) - skew(change[:, TURN]), points - centre - change[:, MOVE]
    moved = centre + (by_point @ away[..., None])[..., 0]
    return moved, by_point, np.concatenate((skew(away), -by_point), axis=2)


def by_changes(camera: Camera, points: Array) -> tuple[Array, Array]:
    """Derivatives of the pixels of points (n, 3) m by these (n, 2, 3) px/m, and by the camera's changes (n, 2, 7)."""
    pixels, by_point = CameraBank([camera]).jacobian(points, np.zeros(len(points), dtype=np.int64))
    *_, by_place = slopes_of(points, camera.centre, np.zeros((len(points), CHANGES)))
    grown = pixels - camera.matrix[:2, 2]
    return by_point, np.concatenate((by_point @ by_place, grown[..., None]), axis=2)


def skew(vectors: Array) -> Array:
    """(n, 3, 3) whose products with b are the cross products of vectors (n, 3) and b."""
    found = np.zeros((*vectors.shape, 3))
    x, y, z = vectors.T
    found[:, 0, 1], found[:, 0, 2], found[:, 1, 2] = -z, y, -x
    found[:, 1, 0], found[:, 2, 0], found[:, 2, 1] = z, -y, x
    return found
