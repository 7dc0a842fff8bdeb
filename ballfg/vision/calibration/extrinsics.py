"""Finds a camera's pose from world points in its image, such as the table's corners."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from scipy.stats import chi2

from ballfg.arrays import Array
from ballfg.checks import listed, shown
from ballfg.vision.calibration.intrinsics import POSE, rms, slopes_of
from ballfg.vision.calibration.table_points import Marked
from ballfg.vision.camera import Camera

MIN_POINTS: Final = 4  # three points have up to four poses
FLAT: Final = 0.01  # share of the points' extent: points closer to a line or plane count as lying in it
MAX_RMS: Final = 4.0  # multiple of the pixels' sigma: with larger residuals a point has a wrong name or place
CLEARLY: Final = 9.0  # least excess of the second best pose, in sums of squared whitened residuals: three sigmas
_HALF_TURNS: Final = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float64)
_REFINE: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """A camera with a known pose."""

    camera: Camera

    marked: Marked  # the points of its calibration
    covariance: Array
    """(6, 6) of a small turn of the camera about the world's axes (rad) and of its centre (m), for an exact lens."""

    @property
    def residuals(self) -> Array:
        """(n, 2) px, points as seen minus as projected."""
        return np.asarray(self.marked.pixels - self.camera.project(self.marked.points))

    @property
    def rms(self) -> float:
        """px, root mean square length of the residuals."""
        return rms(self.residuals)

    @property
    def chance(self) -> float:
        """Probability that the noise of the marks alone makes residuals as large as these."""
        freedom = 2 * len(self.marked.points) - POSE
        return float(chi2.sf(squares(self.camera, self.marked), freedom))

    @property
    def turn_sigma(self) -> float:
        """rad, standard deviation of the camera's direction along its worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def centre_sigma(self) -> float:
        """m, standard deviation of the camera's place along its worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))


def calibrate_extrinsics(lens: Camera, marked: Marked) -> Extrinsics:
    """Poses the lens such that the marked points project to their pixels.

    Every pose that could be meant is refined: a flat target has two. One from which the points would be seen from
    below is not meant.

    Args: lens: a camera; its pose and covariance have no part.  marked: at least four points, not in one line.
    Raises: ValueError: too few points or all in a line, none in the image, no pose that explains them, or two that
        do; the message names the camera.
    Source: T. Collins, A. Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109, 2014 (OpenCV's IPPE);
        for points out of a plane G. Terzakis, M. Lourakis, "A consistently fast and globally optimal solution to the
        perspective-n-point problem", ECCV 2020 (SQPNP).
    """
    found = likely_poses(lens, marked)
    check_one(found, [squares(camera, marked) for camera in found], marked)
    best = Extrinsics(found[0], marked, np.zeros((6, 6)))
    return replace(best, covariance=_covariance(best))


def likely_poses(lens: Camera, marked: Marked) -> list[Camera]:
    """The lens at each place that could be meant, best first. Raises: ValueError: as `calibrate_extrinsics`."""
    flat = _check_points(lens, marked)
    poses = sorted(_poses(lens, marked, flat), key=lambda camera: squares(camera, marked))
    above = [camera for camera in poses if not flat or _is_above(camera, marked.points)]
    if not above:
        rule = "points must be seen from above; these are mirrored, as if seen from below"
        raise ValueError(f"camera {shown(lens.name)}: {rule}. Swap left and right, or correct the points.")
    return [camera for i, camera in enumerate(above) if not any(_alike(camera, better) for better in above[:i])]


def _alike(one: Camera, other: Camera) -> bool:
    """True if two poses of a camera stand at the same place."""
    return bool(np.linalg.norm(one.centre - other.centre) <= FLAT * np.linalg.norm(other.tvec))


def check_one(cameras: Sequence[Camera], costs: Sequence[float], marked: Marked) -> None:
    """Refuses poses of which the best does not explain the points, or another one explains them as well.

    Args: cameras: best first.  costs: of each, a sum of squared whitened residuals.
    Raises: ValueError.
    """
    best = Extrinsics(cameras[0], marked, np.zeros((POSE, POSE)))
    where = f"camera {shown(best.camera.name)}"
    if best.rms > (most := MAX_RMS * marked.sigma):
        problem = f"{where}: points must be explained within {most:g} px; got {best.rms:.1f}"
        raise ValueError(f"{problem}. {_culprit(best)}Check names and pixels, and that the lens is this camera's.")
    rivals = [camera for camera, cost in zip(cameras, costs, strict=True) if cost - costs[0] < CLEARLY]
    if not all(_alike(rival, best.camera) for rival in rivals):
        problem = f"{where}: points must tell one pose; two explain them alike"
        raise ValueError(f"{problem}. Mark more points, farther apart or at other heights.")


def _check_points(lens: Camera, marked: Marked) -> bool:
    """True if the points lie in a plane; refuses points that do not determine a pose."""
    where = f"camera {shown(lens.name)}"
    if len(marked.points) < MIN_POINTS:
        got = f"{len(marked.points)} ({listed(marked.names)})"
        raise ValueError(f"{where}: at least {MIN_POINTS} points must be marked; got {got}. Mark more.")
    inside = ((marked.pixels >= -0.5) & (marked.pixels <= np.array(lens.size) - 0.5)).all(axis=1)
    if not inside.all():
        first = int(np.argmin(inside))
        got = f"{marked.names[first]} is at {marked.pixels[first].tolist()}"
        problem = f"{where}: pixels must lie in the image of {lens.size[0]}x{lens.size[1]}; {got}"
        raise ValueError(f"{problem}. Correct it, or the camera's size.")
    extent = np.linalg.svd(marked.points - marked.points.mean(axis=0), compute_uv=False)
    seen = np.linalg.svd(marked.pixels - marked.pixels.mean(axis=0), compute_uv=False)
    if extent[1] < FLAT * extent[0] or seen[1] < FLAT * seen[0]:
        problem = f"{where}: points must not lie in one line; {listed(marked.names)} do"
        raise ValueError(f"{problem}. Mark points on both sides of the table.")
    return bool(extent[2] < FLAT * extent[1])


def _poses(lens: Camera, marked: Marked, flat: bool) -> list[Camera]:
    points, pixels = np.ascontiguousarray(marked.points), np.ascontiguousarray(marked.pixels)
    given = (points, pixels, lens.matrix, lens.distortion)
    try:
        refined = [
            cv2.solvePnPRefineLM(*given, rvec, tvec, criteria=_REFINE) for rvec, tvec in _starts(lens, marked, flat)
        ]
    except cv2.error:
        refined = []
    cameras = [
        replace(lens, rvec=np.ravel(rvec), tvec=np.ravel(tvec), covariance=None)
        for rvec, tvec in refined
        if np.isfinite(rvec).all() and np.isfinite(tvec).all()
    ]
    cameras = [camera for camera in cameras if (camera.depth(points) > 0.0).all()]
    if not cameras:
        problem = "points must be explained by some pose; there is none with them all in front of the camera"
        raise ValueError(f"camera {shown(lens.name)}: {problem}. Check which point is which.")
    return cameras


def _starts(lens: Camera, marked: Marked, flat: bool) -> list[tuple[Array, Array]]:
    """Rotation vectors and translations to refine.

    OpenCV's IPPE needs a flat target in the plane z = 0, and returns a wrong vector for a rotation by nearly half a
    turn. It gets the points in the target's own axes, and in these after half a turn about each of them: whatever the
    pose, one of the four rotations is at most 120 degrees.
    """
    given = (marked.pixels.copy(), lens.matrix, lens.distortion)
    mean = marked.points.mean(axis=0)
    if not flat:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(marked.points.copy(), *given, flags=cv2.SOLVEPNP_SQPNP)
        return [(np.asarray(rvec), np.asarray(tvec)) for rvec, tvec in zip(rvecs, tvecs, strict=True)]
    own = np.linalg.svd(marked.points - mean)[2]
    own[2] *= np.linalg.det(own)  # a rotation, no mirror
    starts = []
    for signs in _HALF_TURNS:
        axes = signs[:, None] * own
        plane = (marked.points - mean) @ axes.T * (1.0, 1.0, 0.0)
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(plane, *given, flags=cv2.SOLVEPNP_IPPE)
        for rvec, tvec in zip(rvecs, tvecs, strict=True):
            turn = cv2.Rodrigues(rvec)[0] @ axes
            starts.append((cv2.Rodrigues(turn)[0], tvec - turn @ mean[:, None]))
    return starts


def squares(camera: Camera, marked: Marked) -> float:
    """Sum of squared whitened residuals; infinite where a point cannot be seen."""
    total = float(((camera.project(marked.points) - marked.pixels) ** 2).sum() / marked.sigma**2)
    return total if np.isfinite(total) else np.inf


def noise_shown(camera: Camera, marked: Marked) -> float:
    """px, the standard deviation of the marks as stated, or as the residuals at a fitted pose show, if that is more."""
    freedom = 2 * len(marked.points) - POSE
    return marked.sigma * max(1.0, float(np.sqrt(squares(camera, marked) / freedom)))


def _is_above(camera: Camera, points: Array) -> bool:
    """True if the camera stands above the points' plane; an upright plane has two valid sides."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre)[2][2]
    return bool((camera.centre - centre) @ normal * normal[2] >= 0.0)


def _culprit(found: Extrinsics) -> str:
    """A sentence with the one point whose removal resolves the error, if there is one."""
    marked = found.marked
    for i in range(len(marked.names) if len(marked.names) > MIN_POINTS + 1 else 0):
        names = (*marked.names[:i], *marked.names[i + 1 :])
        points, pixels = (np.delete(array, i, axis=0) for array in (marked.points, marked.pixels))
        rest = Marked(names, points, pixels, marked.sigma)
        cameras = _poses(found.camera, rest, _check_points(found.camera, rest))
        if min(rms(camera.project(rest.points) - rest.pixels) for camera in cameras) <= MAX_RMS / 3 * marked.sigma:
            return f"Without {shown(marked.names[i])} the others agree. "
    return ""


def _covariance(found: Extrinsics) -> Array:
    """(6, 6) of a small turn about the world's axes and of the centre, from the slope of the pixels by both."""
    camera, marked = found.camera, found.marked
    by_pose = slopes_of(camera, marked.points, camera.rvec, camera.tvec)[:, :POSE]
    rotation, slope = cv2.Rodrigues(camera.rvec)
    slopes = np.asarray(slope, dtype=np.float64).reshape(3, 3, 3)  # of the rotation, by the three of rvec
    skews = [rotation.T @ by_r for by_r in slopes]  # of the inverse of the turn, as in `changed`
    axes = [np.array([skew[1, 2] - skew[2, 1], skew[2, 0] - skew[0, 2], skew[0, 1] - skew[1, 0]]) for skew in skews]
    turns = np.stack(axes, axis=1) / 2.0
    centres = np.stack([-by_r.T @ camera.tvec for by_r in slopes], axis=1)
    moved = np.block([[turns, np.zeros((3, 3))], [centres, -rotation.T]])
    sigma = noise_shown(camera, marked)
    return np.asarray(sigma**2 * moved @ np.linalg.inv(by_pose.T @ by_pose) @ moved.T)
