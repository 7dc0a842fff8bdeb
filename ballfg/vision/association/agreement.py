"""Checks whether the cameras agree, and finds a camera that has moved since its calibration.

Each camera in turn is turned and moved (six numbers) together with all points until the reprojection error is least,
while the other cameras are fixed. The camera that moved then explains the disagreement, and no other one does. Three
cameras are needed: of two that disagree either may be wrong.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from scipy.stats import chi2

from ballfg.arrays import Array
from ballfg.vision.association.gathering import SeenBall
from ballfg.vision.association.paths import path
from ballfg.vision.association.triangulate import HOPELESS, MAX_SIGMA, triangulate
from ballfg.vision.calibration.intrinsics import POSE, slopes_of
from ballfg.vision.camera import Camera

LEAST_MISFIT: Final = 3.0  # squared error of agreeing cameras over the noise's: half a pixel for centres good to 0.3
LEAST_EXPLAINED: Final = 0.8  # least share of the error beyond noise that a culprit must explain
CLEARLY: Final = 4.0  # least ratio of another camera's unexplained error: correcting a wrong one of three may halve it
CLEARLY_WORSE: Final = 1.5  # least ratio of the squared errors, noise included
LEAST_POINTS: Final = 20  # fewest points, each seen by three cameras or more: six numbers are fitted to them
MOST_POINTS: Final = 600  # most points that are used, evenly spread: more do not change the answer
_LOOSE: Final = 20.0  # px, noise for points from views that may be wrong
_UNSEEN: Final = 1e4  # px, error of a sighting whose point lies behind the camera or beyond its lens
_FAR: Final = 9.0  # median squared errors at which a point counts half
_STEPS: Final = 8  # Gauss-Newton steps; a camera turned by five degrees is right after six
_TURNED, _SHIFTED = 0.1, 0.3  # rad, m: standard deviations of a nudge
_PRIOR: Final = np.diag([_TURNED**-2] * 3 + [_SHIFTED**-2] * 3)
"""Information about a nudge: keeps the fit in place where points are too few."""
LARGEST_MOVE: Final = 2.0  # of these standard deviations: what needs more is no nudge, but a wrong clock, name or place
LEAST_SHARE: Final = 0.25  # least share of the points at which a camera that was nudged saw the ball


@dataclass(frozen=True)
class CameraAgreement:
    """One camera compared with the others."""

    residual: float
    """px, median distance of its sightings from the points of the others; NaN if fewer than two others saw them."""
    explained: float
    """Share of the disagreement beyond noise that a correction of this camera removes; NaN without disagreement."""
    rotation: float  # degrees, turn of that correction
    shift: float  # m, shift of its centre in that correction
    corrected: float  # px, the median distance with the corrected camera; NaN where `residual` is


@dataclass(frozen=True)
class Agreement:
    """The agreement of calibrated cameras on the balls that they saw."""

    culprit: str | None
    """The one camera whose small move explains the disagreement; None if they agree or if no single one does."""
    by_camera: Mapping[str, CameraAgreement]
    """By name, in the rig's order; empty where too little was seen by three cameras."""
    misfit: float
    """Median squared reprojection error over that of the noise: about 1 where cameras agree; NaN if not known."""
    sentence: str  # a summary for readers


@dataclass(frozen=True, eq=False)
class _Scene:
    """Points that at least three cameras saw."""

    pixels: Array  # (n, c, 2), NaN where not seen
    weights: Array  # (n, c, 2, 2) inverse covariances; zero where not seen
    points: Array  # (n, 3) m, first guess
    expected: Array  # (n,) median of the squared error that noise alone makes
    shares: Array  # (c,) of all points, of two cameras too, the share at which each camera saw the ball


def check_agreement(balls: Sequence[SeenBall], cameras: Sequence[Camera]) -> Agreement:
    """Checks whether the cameras agree and, if not, which one has moved.

    Args: balls: as `associate` gives them, for the same cameras.
    Source: docs/associate.md.
    """
    cameras = list(cameras)
    scene = _scene(balls, cameras)
    if (few := len(scene.points)) < LEAST_POINTS:
        why = f"{few} points were seen by three cameras or more; {LEAST_POINTS} are needed to check them."
        return Agreement(None, {}, float("nan"), f"Whether the cameras agree is not known: {why}")
    before = _misfit(scene, cameras, _refined(scene, cameras, scene.points, None)[0])
    by_camera = {}
    for k, camera in enumerate(cameras):
        points, corrected = _refined(scene, cameras, scene.points, k)
        rest = _misfit(scene, corrected, points)
        excess = before - 1.0
        turn = np.linalg.norm(cv2.Rodrigues(corrected[k].rotation @ camera.rotation.T)[0])
        by_camera[camera.name] = CameraAgreement(
            _against_others(scene, cameras, k),
            float((before - max(rest, 1.0)) / excess) if before > LEAST_MISFIT else float("nan"),
            float(np.degrees(turn)),
            float(np.linalg.norm(corrected[k].centre - camera.centre)),
            _against_others(scene, corrected, k),
        )
    suspect = _culprit(by_camera, before) if before > LEAST_MISFIT else None
    shares = dict(zip(by_camera, scene.shares.tolist(), strict=True))
    moved = suspect is not None and _may_have_moved(by_camera[suspect], shares[suspect])
    rare = min(shares, key=lambda name: shares[name])
    if suspect is not None and not moved and shares[rare] < LEAST_SHARE:  # few points are fitted by any camera's pose
        suspect = rare
    sentence = _sentence(suspect, by_camera, before, moved=moved)
    return Agreement(suspect if moved else None, by_camera, before, sentence)


def _scene(balls: Sequence[SeenBall], cameras: list[Camera]) -> _Scene:
    """The points, with the pixels of the balls in every camera at the points' times."""
    ends = np.cumsum([0, *map(len, balls)])
    pixels = np.full((ends[-1], len(cameras), 2), np.nan)
    covariances = np.full((ends[-1], len(cameras), 2, 2), np.nan)
    for ball, start, end in zip(balls, ends[:-1], ends[1:], strict=True):
        own = ball.sightings
        for k, camera in enumerate(cameras):
            mine = own.camera == own.cameras.index(camera.name)
            if mine.any():
                times = camera.true_times(own.times[mine], own.pixels[mine])
                line = path(times, own.pixels[mine], own.covariances[mine])
                pixels[start:end, k], covariances[start:end, k] = line.at(ball.times)
    seen = np.asarray(np.isfinite(pixels).all(axis=-1))
    rows = np.flatnonzero(seen.sum(axis=1) >= 3)
    if len(rows):
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST_POINTS)).astype(int))]
    loose = np.broadcast_to(_LOOSE**2 * np.eye(2), covariances[rows].shape)
    points = triangulate(cameras, pixels[rows], loose).points if len(cameras) > 1 else np.zeros((0, 3))
    rows, points = rows[np.isfinite(points).all(axis=1)], points[np.isfinite(points).all(axis=1)]
    weights = np.zeros(covariances[rows].shape)
    weights[seen[rows]] = np.linalg.inv(covariances[rows][seen[rows]])
    shares = seen.sum(axis=0) / max(len(seen), 1)
    return _Scene(pixels[rows], weights, points, chi2.median(2 * seen[rows].sum(axis=1) - 3), shares)


def _errors(scene: _Scene, cameras: list[Camera], points: Array) -> Array:
    """(n, c, 2) px, seen minus projected; zero where not seen, `_UNSEEN` for an impossible sighting."""
    projected = np.stack([camera.project(points) for camera in cameras], axis=1)
    errors = np.clip(np.nan_to_num(scene.pixels - projected, nan=_UNSEEN), -_UNSEEN, _UNSEEN)
    return np.where(np.isnan(scene.pixels), 0.0, errors)


def _misfit(scene: _Scene, cameras: list[Camera], points: Array) -> float:
    errors = _errors(scene, cameras, points)
    return float(np.median(np.einsum("nci,ncij,ncj->n", errors, scene.weights, errors) / scene.expected))


def _refined(scene: _Scene, cameras: list[Camera], points: Array, nudged: int | None) -> tuple[Array, list[Camera]]:
    """Gauss-Newton on all points and, if one is named, on a camera's pose: the points and the cameras then."""
    cameras = list(cameras)
    first = cameras[nudged or 0]
    start = np.concatenate((first.rvec, first.tvec))
    for _ in range(_STEPS):
        errors = _errors(scene, cameras, points)
        slopes, by_point, information = _slopes(scene, cameras, points, errors)
        weighted = scene.weights @ by_point
        gradient = np.einsum("ncij,nci->nj", weighted, errors)
        points = points + np.linalg.solve(information, gradient[..., None])[..., 0]
        if nudged is not None:
            by_pose = slopes[:, nudged]
            mine = scene.weights[:, nudged] @ by_pose
            mixed = np.einsum("nij,nik->njk", weighted[:, nudged], by_pose)
            removed = np.linalg.solve(information, mixed)
            # Cauchy weights: points far worse than the median count less
            squares = np.einsum("nci,ncij,ncj->n", errors, scene.weights, errors)
            trust = 1.0 / (1.0 + squares / (_FAR * (np.median(squares) + 1.0)))
            # The points are eliminated from the normal equations (Schur complement).
            schur = np.einsum("n,nij,nik->jk", trust, mine, by_pose) - np.einsum("n,nji,njk->ik", trust, mixed, removed)
            target = np.einsum("n,nij,ni->j", trust, mine, errors[:, nudged])
            target -= np.einsum("n,nji,nj->i", trust, removed, gradient)
            pose = np.concatenate((cameras[nudged].rvec, cameras[nudged].tvec))
            change = np.linalg.solve(schur + _PRIOR, target - _PRIOR @ (pose - start))
            points = points - removed @ change
            pose = pose + change
            cameras[nudged] = replace(cameras[nudged], rvec=pose[:3], tvec=pose[3:])
    return points, cameras


def _slopes(scene: _Scene, cameras: list[Camera], points: Array, errors: Array) -> tuple[Array, Array, Array]:
    """Slopes of the pixels by the poses (n, c, 2, 6) and by the points (n, c, 2, 3), and the points' information.

    Slopes are zero for impossible sightings, and for points that have run away, which the others hold nowhere: these
    stay where they are, with their misfit, and move no camera. Their information (n, 3, 3) is that of one.
    """
    poses = [slopes_of(c, points, c.rvec, c.tvec)[:, :POSE].reshape(-1, 2, POSE) for c in cameras]
    possible = np.asarray((np.abs(errors) < _UNSEEN).all(axis=2))
    slopes = np.where(possible[..., None, None], np.stack(poses, axis=1), 0.0)
    by_point = slopes[..., 3:] @ np.stack([camera.rotation for camera in cameras])
    information = np.einsum("ncij,ncik->njk", by_point, scene.weights @ by_point)
    lost = np.asarray(~np.isfinite(information).all(axis=(1, 2)))
    information[lost] = 0.0
    least, _, most = np.linalg.eigvalsh(information).T
    lost |= (least * MAX_SIGMA**2 <= HOPELESS) | (least <= HOPELESS**2 * most)
    slopes[lost], by_point[lost], information[lost] = 0.0, 0.0, np.eye(3)
    return slopes, by_point, information


def _against_others(scene: _Scene, cameras: list[Camera], k: int) -> float:
    """px, median distance of a camera's sightings from the points of the others."""
    others = scene.pixels.copy()
    others[:, k] = np.nan
    points = triangulate(cameras, others, np.broadcast_to(_LOOSE**2 * np.eye(2), (*others.shape, 2))).points
    distance = np.linalg.norm(scene.pixels[:, k] - cameras[k].project(points), axis=1)
    return float(np.nanmedian(distance)) if np.isfinite(distance).any() else float("nan")


def _culprit(by_camera: Mapping[str, CameraAgreement], misfit: float) -> str | None:
    ranked = sorted(by_camera, key=lambda name: -by_camera[name].explained)
    left, next_left = (1.0 - by_camera[name].explained for name in ranked[:2])
    error, next_error = (1.0 + share * (misfit - 1.0) for share in (left, next_left))
    clear = next_left >= CLEARLY * left and next_error >= CLEARLY_WORSE * error
    return ranked[0] if left <= 1.0 - LEAST_EXPLAINED and clear else None


def _may_have_moved(seen: CameraAgreement, share: float) -> bool:
    """True for a correction as small as a knock makes; a wrong clock or name asks for a large one, or hides balls."""
    size = np.hypot(np.radians(seen.rotation) / _TURNED, seen.shift / _SHIFTED)
    return bool(size <= LARGEST_MOVE and share >= LEAST_SHARE)


def _sentence(culprit: str | None, by_camera: Mapping[str, CameraAgreement], misfit: float, *, moved: bool) -> str:
    distances = ", ".join(f"{name} {seen.residual:.2f} px" for name, seen in by_camera.items())
    each = f"each from the points of the others by {distances}"
    if misfit <= LEAST_MISFIT:
        return f"The cameras agree: {each}."
    if culprit is None:
        why = f"The cameras disagree, and no single one explains it ({each})."
        return f"{why} Calibrate them again, and check their time offsets."
    seen = by_camera[culprit]
    if not moved:
        problem = f"Camera {culprit} does not fit the others: it is off by {seen.residual:.1f} px from their points"
        return f"{problem}, and no small move explains it. Check its clock (time_offset), its name and its pose."
    return (
        f"Camera {culprit} has moved since its calibration: it is off by {seen.residual:.1f} px from the points of the "
        f"others, {seen.corrected:.1f} px if turned by {seen.rotation:.2f} degrees and shifted by "
        f"{1000 * seen.shift:.0f} mm. Calibrate it again."
    )
