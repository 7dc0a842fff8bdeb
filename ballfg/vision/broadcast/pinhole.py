"""Cameras with square pixels and the principal point in the middle, by turn, place, focal length and one distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.camera import Camera

ROUNDS: Final = 5


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera at a place: `turn` (3, 3) from the world to it, `place` (3,) m, `focal` px, `size` px of the image.

    `bend` is the first radial coefficient of OpenCV's distortion, k1.
    """

    turn: Array
    place: Array
    focal: float
    size: tuple[int, int]
    bend: float = 0.0

    @property
    def middle(self) -> Array:
        """(2,) px, the principal point."""
        return (np.array(self.size) - 1.0) / 2.0

    @property
    def matrix(self) -> Array:
        """(3, 3) px, of OpenCV."""
        return np.array([[self.focal, 0.0, self.middle[0]], [0.0, self.focal, self.middle[1]], [0.0, 0.0, 1.0]])

    def project(self, points: Array) -> Array:
        """(..., 2) px of points (..., 3) m; NaN behind the camera."""
        at = (points - self.place) @ self.turn.T
        depth = np.where(at[..., 2:] > 0.0, at[..., 2:], np.nan)
        seen = at[..., :2] / depth
        bent = 1.0 + self.bend * (seen**2).sum(axis=-1, keepdims=True)
        return np.asarray(self.focal * bent * seen + self.middle)

    def directions(self, pixels: Array) -> Array:
        """(..., 3) of pixels (..., 2), in the camera's frame, with z = 1 and the distortion undone."""
        seen = (pixels - self.middle) / self.focal
        plane = undone(seen, self.bend)
        return np.concatenate((plane, np.ones((*plane.shape[:-1], 1))), axis=-1)

    def onto(self, pixels: Array, other: Pinhole, near: float = 0.0) -> Array:
        """(..., 2) px where another camera sees what this one sees at pixels (..., 2).

        Args: near: 1/m, one over its distance along the axis; 0: it is far away, or both are at one place.
        """
        return other.project(other.place + near * (self.place - other.place) + self.directions(pixels) @ self.turn)

    def camera(self, name: str, covariance: Array | None = None) -> Camera:
        """The same as a camera of the other rooms; covariance: (7, 7) of turn, place and log focal length."""
        rvec = np.asarray(cv2.Rodrigues(self.turn)[0], dtype=np.float64).ravel()
        tvec = -self.turn @ self.place
        return Camera(
            name, self.size, self.matrix, np.array([self.bend, 0.0, 0.0, 0.0]), rvec, tvec, covariance=covariance
        )


def undone(seen: Array, bend: float) -> Array:
    """(..., 2) x/z and y/z of distorted ones (..., 2), by Newton's method for the distance from the middle."""
    bent = np.linalg.norm(seen, axis=-1, keepdims=True)
    plain = bent
    for _ in range(ROUNDS):
        plain = plain - (plain * (1.0 + bend * plain**2) - bent) / (1.0 + 3.0 * bend * plain**2)
    return np.asarray(seen / (1.0 + bend * plain**2))


def posed(homographies: Array, focal: Array) -> tuple[Array, Array]:
    """Turns (n, 3, 3) and places (n, 3) m of cameras that see a plane z = 0 by homographies.

    Args: homographies: (n, 3, 3) from (x, y, 1) m to pixels about the principal point.  focal: (n,) px.
    Source: Zhang, "A flexible new technique for camera calibration", 2000, section 3.1.
    """
    seen = homographies / np.stack((focal, focal, np.ones_like(focal)), axis=1)[..., None]
    seen = seen / np.sqrt(np.linalg.norm(seen[..., 0], axis=1) * np.linalg.norm(seen[..., 1], axis=1))[:, None, None]
    seen = seen * np.sign(seen[:, 2, 2])[:, None, None]
    left, _, right = np.linalg.svd(seen[..., :2], full_matrices=False)
    turn = left @ right  # the nearest two columns of a rotation
    turn = np.concatenate((turn, np.cross(turn[..., 0], turn[..., 1])[..., None]), axis=2)
    return turn, -(turn.swapaxes(1, 2) @ seen[..., 2:])[..., 0]
