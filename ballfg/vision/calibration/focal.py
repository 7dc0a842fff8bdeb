"""Poses a camera with a roughly known focal length by table points, and finds the covariance of all seven numbers."""

from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_range
from ballfg.vision.calibration.extrinsics import Extrinsics, calibrate_extrinsics
from ballfg.vision.calibration.table_points import Marked
from ballfg.vision.camera import Camera
from ballfg.vision.camera_change import CHANGES, ZOOM, changed, slopes_of
from ballfg.vision.projection import CameraBank

ROUGHLY: Final = (1e-4, 0.3)  # Smallest and largest relative standard deviation of a focal length
TRIED: Final = (0.0, -1.0, 1.0, -2.0, 2.0)
"""Standard deviations of a focal length at which a pose may explain the points."""
ROUNDS: Final = 20
SETTLED: Final = 1e-6  # Standard deviations. A step that is shorter ends the search


def pose_and_focal(lens: Camera, marked: Marked, focal_sigma: float) -> Extrinsics:
    """The most probable pose and focal length, with a covariance in the camera, for a focal length known roughly.

    Args: lens: a camera; its pose has no part.  marked: at least four points, not in one line.
        focal_sigma: dimensionless, relative standard deviation of the focal length.
    Raises: ValueError: as `calibrate_extrinsics`, or a focal_sigma out of range.
    """
    check_range("focal_sigma", focal_sigma, *ROUGHLY)
    camera = _first(lens, marked, focal_sigma)
    for _ in range(ROUNDS):
        slope, missed = _slopes(camera, marked.points), marked.pixels - camera.project(marked.points)
        information = slope.T @ slope / marked.sigma**2
        pull = slope.T @ missed.ravel() / marked.sigma**2
        information[ZOOM, ZOOM] += focal_sigma**-2
        pull[ZOOM] += np.log(lens.matrix[0, 0] / camera.matrix[0, 0]) / focal_sigma**2
        step = np.asarray(np.linalg.solve(information, pull), dtype=np.float64)
        camera = changed(camera, step)
        if step @ information @ step < SETTLED**2:
            break
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Extrinsics(replace(camera, covariance=covariance), marked, covariance[:ZOOM, :ZOOM])


def _first(lens: Camera, marked: Marked, focal_sigma: float) -> Camera:
    """A camera that explains the points, of a likely focal length."""
    refused = list[ValueError]()
    for zoom in focal_sigma * np.array(TRIED):
        try:
            return calibrate_extrinsics(changed(lens, np.append(np.zeros(ZOOM), zoom)), marked).camera
        except ValueError as error:
            refused.append(error)
    raise refused[0]


def _slopes(camera: Camera, points: Array) -> Array:
    """(2 n, 7) px of the pixels of points (n, 3) m by the camera's changes."""
    pixels, by_point = CameraBank([camera]).jacobian(points, np.zeros(len(points), dtype=np.int64))
    *_, by_place = slopes_of(points, camera.centre, np.zeros((len(points), CHANGES)))
    grown = pixels - camera.matrix[:2, 2]
    return np.concatenate((by_point @ by_place, grown[..., None]), axis=2).reshape(-1, CHANGES)
