"""Projects points through many cameras in one torch call, differentiable, with distortion."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ballfg.checks import check_each
from ballfg.vision.camera import Camera


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
        plane = local[:, :2] / torch.where(seen, depth, torch.nan)
        bent = _distorted(plane, self._distortion[camera])
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

    def jacobian(self, points: Tensor, camera: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (n, 2) of points (n, 3) m in the cameras (n,) of their rows, and derivatives (n, 2, 3) px/m."""
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            pixels = self.project(points, camera)
            (by_u,) = torch.autograd.grad(pixels[:, 0].sum(), points, retain_graph=True)
            (by_v,) = torch.autograd.grad(pixels[:, 1].sum(), points)
        return pixels.detach(), torch.stack((by_u, by_v), dim=1)


def _stacked(arrays: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float64))


def _distorted(plane: Tensor, d: Tensor) -> Tensor:
    """(n, 2) x/z, y/z after radial, tangential and thin prism distortion (n, 14)."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = d[:, :12].unbind(-1)
    x, y = plane.unbind(-1)
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return torch.stack((u, v), dim=-1)


def _tilt(tau_x: float, tau_y: float) -> Tensor:
    """(3, 3) homography of a sensor that is tilted against the lens by two angles, rad."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    rotation = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    onto = np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1]])
    return torch.from_numpy(onto @ rotation)
