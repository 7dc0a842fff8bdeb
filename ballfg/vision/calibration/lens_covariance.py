"""Computes the covariance of a lens from views of a board, and its effect in pixels."""

from collections.abc import Sequence
from typing import Final, TypeAlias

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.camera import Camera

PosedBoard: TypeAlias = tuple[Array, Array, Array, Array]
"""Points (n, 3) m of a board, its rvec (3,) and tvec (3,), and the residuals (n, 2) px of its corners."""
GRID_STEP: Final = 16  # px between the pixels of `pixel_grid`: a lens bends no faster
POSE: Final = 6  # numbers of a board's pose; in OpenCV's Jacobian they stand before those of the lens


def covariance_of_lens(camera: Camera, boards: Sequence[PosedBoard]) -> Array:
    """(4 + k, 4 + k) covariance of fx, fy, cx, cy and the k coefficients, the poses of the boards unknown as well.

    The residuals give the noise of a corner. Undetermined directions are infinite.

    Source: the inverse of the Schur complement of the poses in the normal equations; B. Triggs et al., "Bundle
        adjustment - a modern synthesis", 2000, section 6.
    """
    unknowns = 4 + len(camera.distortion)
    information = np.zeros((unknowns, unknowns))
    squares, freedom = 0.0, -unknowns
    for points, rvec, tvec, residuals in boards:
        by_pose, by_lens = np.split(slopes_of(camera, points, rvec, tvec), [POSE], axis=1)
        q, _ = np.linalg.qr(by_pose)
        left = by_lens - q @ (q.T @ by_lens)
        information += left.T @ left
        squares += float((residuals**2).sum())
        freedom += residuals.size - POSE
    scale = np.sqrt(np.diag(information))
    known = freedom > 0 and (scale > 0.0).all()
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale)) if known else (np.zeros(1), scale)
    if values[0] <= np.finfo(np.float64).eps * unknowns:
        return np.diag(np.full(unknowns, np.inf))
    return np.asarray(squares / freedom * (vectors / values) @ vectors.T / np.outer(scale, scale))


def sigma_of_rays(camera: Camera, covariance: Array) -> Array:
    """(m,) px, how well it is known where the lens puts the rays of the pixels of `pixel_grid`: the worse direction.

    A turn of all rays alike does not count: where the camera looks is found later, from the table, with this lens.

    Args: covariance: (4 + k, 4 + k) of the lens.
    """
    if not np.isfinite(covariance).all():
        return np.full(len(pixel_grid(camera)), np.inf)
    plane = camera.normalized(pixel_grid(camera))
    points = np.column_stack((plane, np.ones(len(plane))))
    slopes = slopes_of(camera, points, np.zeros(3), np.zeros(3))
    turns, by_lens = slopes[:, :3], slopes[:, POSE:]
    q, _ = np.linalg.qr(turns)
    left = (by_lens - q @ (q.T @ by_lens)).reshape(len(points), 2, -1)
    spread = left @ covariance @ left.transpose(0, 2, 1)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(spread)[:, 1].clip(min=0.0)))


def pixel_grid(camera: Camera) -> Array:
    """(m, 2) px all over the image, its border included."""
    sides = [np.linspace(0.0, side - 1.0, side // GRID_STEP + 2) for side in camera.size]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


def slopes_of(camera: Camera, points: Array, rvec: Array, tvec: Array) -> Array:
    """(2 n, 6 + 4 + k) of the pixels by rvec, tvec, fx, fy, cx, cy and the coefficients."""
    _, slopes = cv2.projectPoints(points, rvec, tvec, camera.matrix, camera.distortion)
    return np.asarray(slopes, dtype=np.float64)[:, : POSE + 4 + len(camera.distortion)]
