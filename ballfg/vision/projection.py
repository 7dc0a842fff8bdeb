"""Projects points through many cameras, differentiable, and through cameras after small changes, seven numbers each.

A camera with a covariance is uncertain by such a change: its turn, its move and the growth of its focal length. A point
X is seen by the changed camera where the camera as it is sees X' = C + p + p x turn, p = X - C - move, with the centre
C; pixels then grow about the principal point by exp(zoom). The turn is of first order in X', exact in `changed`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.checks import check_each
from ballfg.deferred import torch
from ballfg.vision.camera import Camera

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T", "Tensor", Array)


class CameraBank:
    """The cameras of a rig as stacked tensors.

    Args: cameras: in the order of their numbers.
    Raises: ValueError: no cameras.

    Attributes:
        names: of the cameras, in that order.
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        cameras = tuple(check_each("cameras", cameras, Camera, "Read them with read_cameras."))
        if not cameras:
            raise ValueError("cameras must hold at least one camera; got none")
        self.names = tuple(camera.name for camera in cameras)
        self._rotation = _stacked([camera.rotation for camera in cameras])
        self._tvec = _stacked([camera.tvec for camera in cameras])
        self._focal = _stacked([camera.matrix[[0, 1], [0, 1]] for camera in cameras])
        self._principal = _stacked([camera.matrix[:2, 2] for camera in cameras])
        distortions = [np.pad(camera.distortion, (0, 14 - len(camera.distortion))) for camera in cameras]
        self._distortion = _stacked(distortions)
        self._widest = _stacked([np.array(camera.widest) for camera in cameras])
        self._tilt = None
        if any(len(camera.distortion) == 14 for camera in cameras):
            self._tilt = torch.stack([_tilt(*bent[12:]) for bent in distortions])

    def project(self, points: Tensor, camera: Tensor) -> Tensor:
        """Pixels (n, 2) of points (n, 3) m in the cameras (n,) of their rows; NaN behind one or beyond its lens."""
        local = (self._rotation[camera] @ points.unsqueeze(-1)).squeeze(-1) + self._tvec[camera]
        depth = local[:, 2:]
        seen = (depth > 0.0) & (local[:, :2].detach().norm(dim=-1, keepdim=True) <= self._widest[camera, None] * depth)
        x, y = (local[:, :2] / torch.where(seen, depth, torch.nan)).unbind(-1)
        bent = torch.stack(_distorted(x, y, self._distortion[camera].unbind(-1)), dim=-1)
        if self._tilt is not None:
            tilted = (self._tilt[camera] @ torch.cat((bent, torch.ones_like(depth)), dim=-1).unsqueeze(-1)).squeeze(-1)
            bent = tilted[:, :2] / tilted[:, 2:]
        return bent * self._focal[camera] + self._principal[camera]

    def radius(self, points: Tensor, camera: Tensor, radius: float) -> tuple[Tensor, Tensor]:
        """Mean radius (n,) px of the outline of a ball about each point (n, 3) m, and its derivatives (n, 3) px/m.

        Args: camera: (n,) number of each row's.  radius: m, of the ball.
        """
        forward = self._rotation[camera, 2]
        depth = (forward * points).sum(-1) + self._tvec[camera, 2]
        seen = self._focal[camera].prod(-1).sqrt() * radius / torch.where(depth > 0.0, depth, torch.nan)
        return seen, -(seen / depth)[:, None] * forward

    def jacobian(self, points: Array, camera: Index) -> tuple[Array, Array]:
        """Pixels (n, 2) of points (n, 3) m in the cameras (n,) of their rows, and derivatives (n, 2, 3) px/m.

        Not through torch, whose graph of so few numbers costs ten times as much as they do.
        """
        rotation, focal = self._rotation.numpy()[camera], self._focal.numpy()[camera]
        local = (rotation @ points[..., None])[..., 0] + self._tvec.numpy()[camera]
        x, y, z = local.T
        z = np.where(z > 0.0, z, np.nan)
        z[~(np.hypot(x, y) <= self._widest.numpy()[camera] * z)] = np.nan
        x, y = x / z, y / z
        bent, slope = _bent(x, y, self._distortion.numpy()[camera].T)
        if self._tilt is not None:
            tilt = self._tilt.numpy()[camera]
            tilted = (tilt[..., :2] @ bent[..., None])[..., 0] + tilt[..., 2]
            bent = tilted[:, :2] / tilted[:, 2:]
            slope = (tilt[:, :2, :2] - bent[..., None] * tilt[:, 2:, :2]) / tilted[:, 2:, None] @ slope
        by_plane = rotation[:, :2] - np.stack((x, y), axis=1)[..., None] * rotation[:, 2:]
        by_point = (focal / z[:, None])[..., None] * (slope @ by_plane)
        return bent * focal + self._principal.numpy()[camera], by_point


def _stacked(arrays: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float64))


def _distorted(x: T, y: T, d: Sequence[T]) -> tuple[T, T]:
    """x/z and y/z (n,) after radial, tangential and thin prism distortion, 14 coefficients (n,)."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *_ = d
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return u, v


def _bent(x: Array, y: Array, d: Array) -> tuple[Array, Array]:
    """`_distorted` (n, 2) with coefficients (14, n), and its derivatives (n, 2, 2) by x/z and y/z."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *_ = d
    r2 = x * x + y * y
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    grows = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below
    by_u, by_v = x * grows + 2 * (s1 + 2 * r2 * s2), y * grows + 2 * (s3 + 2 * r2 * s4)
    mixed = 2 * (p1 * x + p2 * y)
    along = radial + x * by_u + 2 * p1 * y + 6 * p2 * x, y * by_u + mixed
    across = x * by_v + mixed, radial + y * by_v + 6 * p1 * y + 2 * p2 * x
    return np.stack(_distorted(x, y, list(d)), axis=1), np.stack(along + across, axis=1).reshape(-1, 2, 2)


def _tilt(tau_x: float, tau_y: float) -> Tensor:
    """(3, 3) homography of a sensor that is tilted against the lens by two angles, rad."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    rotation = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    onto = np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1]])
    return torch.from_numpy(onto @ rotation)


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
