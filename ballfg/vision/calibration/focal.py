"""Poses a camera with a roughly known focal length by table points, and finds the covariance of all seven numbers."""

from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_range
from ballfg.vision.calibration.extrinsics import Extrinsics, check_one, likely_poses, noise_shown, squares
from ballfg.vision.calibration.table_points import Marked
from ballfg.vision.camera import Camera
from ballfg.vision.projection import CHANGES, ZOOM, by_changes, changed

ROUGHLY: Final = (1e-4, 0.3)  # Smallest and largest relative standard deviation of a focal length
TRIED: Final = (0.0, -1.0, 1.0, -2.0, 2.0)  # standard deviations of a focal length from which the search sets out
ROUNDS: Final = 20
HALVINGS: Final = 10  # of a step that does not lower the cost
SETTLED: Final = 1e-6  # Standard deviations. A step that is shorter ends the search


def pose_and_focal(lens: Camera, marked: Marked, focal_sigma: float) -> Extrinsics:
    """The most probable pose and focal length, with a covariance in the camera, for a focal length known roughly.

    The noise of the marks is the stated one, or that of the residuals if it is larger.

    Args: lens: a camera; its pose has no part.  marked: at least four points, not in one line.
        focal_sigma: dimensionless, relative standard deviation of the focal length.
    Raises: ValueError: as `calibrate_extrinsics`, or a focal_sigma out of range.
    """
    check_range("focal_sigma", focal_sigma, *ROUGHLY)
    camera = _first(lens, marked, focal_sigma)
    noisy = replace(marked, sigma=noise_shown(camera, marked))
    camera, covariance = _settled(camera, lens, noisy, focal_sigma)
    return Extrinsics(replace(camera, covariance=covariance), marked, covariance[:ZOOM, :ZOOM])


def _first(lens: Camera, marked: Marked, focal_sigma: float) -> Camera:
    """The most probable camera for the stated noise."""
    refused = list[ValueError]()
    for zoom in focal_sigma * np.array(TRIED):
        try:
            starts = likely_poses(changed(lens, np.append(np.zeros(ZOOM), zoom)), marked)
            found = [_settled(start, lens, marked, focal_sigma)[0] for start in starts]
            costs = [_cost(camera, lens, marked, focal_sigma) for camera in found]
            order = np.argsort(costs, kind="stable").tolist()
            check_one([found[i] for i in order], [costs[i] for i in order], marked)
            return found[order[0]]
        except ValueError as error:
            refused.append(error)
    raise refused[0]


def _settled(camera: Camera, lens: Camera, marked: Marked, focal_sigma: float) -> tuple[Camera, Array]:
    """The most probable camera near one, by Gauss-Newton, and the covariance (7, 7) of its changes."""
    cost = _cost(camera, lens, marked, focal_sigma)
    for _ in range(ROUNDS):
        slope = by_changes(camera, marked.points)[1].reshape(-1, CHANGES)
        missed = marked.pixels - camera.project(marked.points)
        information = slope.T @ slope / marked.sigma**2
        pull = slope.T @ missed.ravel() / marked.sigma**2
        information[ZOOM, ZOOM] += focal_sigma**-2
        pull[ZOOM] -= _zoom(lens, camera) / focal_sigma**2
        step = np.asarray(np.linalg.solve(information, pull), dtype=np.float64)
        if step @ information @ step < SETTLED**2 * max(1.0, cost):
            break
        step /= max(1.0, float(np.abs(step[ZOOM])))
        for _ in range(HALVINGS):
            trial = changed(camera, step)
            if (less := _cost(trial, lens, marked, focal_sigma)) < cost:
                camera, cost = trial, less
                break
            step /= 2.0
        else:
            break
    return camera, np.asarray(np.linalg.inv(information), dtype=np.float64)


def _cost(camera: Camera, lens: Camera, marked: Marked, focal_sigma: float) -> float:
    """Sum of squared whitened residuals, that of the focal length included."""
    return squares(camera, marked) + (_zoom(lens, camera) / focal_sigma) ** 2


def _zoom(lens: Camera, camera: Camera) -> float:
    """Logarithm of the ratio of a camera's focal length and the stated one."""
    return float(np.log(camera.matrix[0, 0] / lens.matrix[0, 0]))
