"""Calibrates a lens from views of a board, with its covariance, and checks whether the views determine it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.vision.calibration.boards import View
from ballfg.vision.camera import DISTORTIONS, Camera
from ballfg.vision.one_thread import one_thread

MIN_VIEWS: Final = 3  # a view tells two numbers about the lens (Zhang 2000, section 2.3)
USUAL_VIEWS: Final = 8  # with fewer, a bent board or a wrong corner looks like the lens
MIN_TURN: Final = np.radians(10.0)  # rad between two boards: parallel ones confuse a long lens with a near board
MAX_FOCAL_SIGMA: Final = 0.02  # relative standard deviation of the focal length: 2 % are 6 cm at a distance of 3 m
MIN_COVERAGE: Final = 0.4  # of the image's cells with corners: outside of them, the distortion is extrapolated
CELLS: Final = (8, 5)  # number of such cells across and down
OUTLYING: Final = 3.0  # medians of the views' errors: a view beyond has a wrong corner or moved while it was exposed
MIN_OUTLYING: Final = 0.15  # px. A view with a smaller error is kept, however good the others are.
MAX_LEFT_OUT: Final = 1 / 3  # share of views that are left out: if more disagree, the rest may be wrong
MAX_RAY_SIGMA: Final = 1.0  # px, largest standard deviation of a projected ray: 3 mm at a distance of 3 m
RAYS: Final = 0.95  # share of the image to which that applies: the outermost corners of a wide lens rarely see a board
MAX_FOLD: Final = 0.05  # px: distortion undone and done again leads back to each pixel, or the model folds the image
_CRITERIA: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
_FIX_RADIAL: Final = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
_FLAGS: Final = {
    0: _FIX_RADIAL | cv2.CALIB_ZERO_TANGENT_DIST,
    4: cv2.CALIB_FIX_K3,
    5: 0,
    8: cv2.CALIB_RATIONAL_MODEL,
    12: cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL,
    14: cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL,
}


@dataclass(frozen=True, eq=False)
class FittedView:
    """A view with the pose of its board and the residuals of the lens."""

    view: View

    rvec: Array  # (3,) rad, rotation from the board to the camera
    tvec: Array  # (3,) m, the board's origin in the camera's frame
    residuals: Array  # (n, 2) px, corners as seen minus as projected

    @property
    def normal(self) -> Array:
        """(3,) the board's normal in the camera's frame."""
        return np.asarray(cv2.Rodrigues(self.rvec)[0], dtype=np.float64)[:, 2]

    @property
    def rms(self) -> float:
        """px, root mean square length of the residuals."""
        return rms(self.residuals)


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A calibrated lens."""

    camera: Camera  # the camera at the world's origin, unturned: its pose is unknown
    covariance: Array  # (4 + k, 4 + k) of fx, fy, cx, cy (px) and the k coefficients of the distortion
    views: tuple[FittedView, ...]  # the views of the calibration
    left_out: tuple[FittedView, ...]  # the views that disagree with it, in the order of their removal
    missed: tuple[str, ...]  # names of the images in which no board was found
    coverage: float  # share of the image's cells that hold corners

    @property
    def sigmas(self) -> Array:
        """(4 + k,) standard deviations of fx, fy, cx, cy (px) and the coefficients of the distortion."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def ray_sigma(self) -> tuple[float, float]:
        """px, standard deviation of the projected rays: the largest in `RAYS` of the image, and in all of it."""
        sigmas = np.sort(sigma_of_rays(self.camera, self.covariance))
        return float(sigmas[int(RAYS * (len(sigmas) - 1))]), float(sigmas[-1])

    @property
    def rms(self) -> float:
        """px, root mean square length of the residuals of `views`."""
        return rms(np.concatenate([v.residuals for v in self.views]))


def calibrate_intrinsics(name: str, views: Sequence[View], distortion: int = 5) -> Intrinsics:
    """Matrix and distortion of a camera.

    Args: views: of one board that lay at different places, turned differently; those without corners are counted only.
        distortion: how many coefficients: 0, 4, 5, 8, 12 or 14.
    Raises: ValueError: too few views, images of several sizes, views that cannot tell the focal length, corners in a
        small part of the image only, or too many views that disagree; the message names the camera.
    Source: Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (11), 2000; OpenCV's
        `calibrateCamera`.
    """
    if distortion not in DISTORTIONS:
        lengths = ", ".join(map(str, DISTORTIONS))
        raise ValueError(f"distortion must be one of {lengths} coefficients; got {distortion}. 5 do for most lenses.")
    where, missed = f"camera {shown(name)}", tuple(view.name for view in views if len(view.pixels) == 0)
    used = [view for view in views if len(view.pixels)]
    _check_views(name, used, missed)
    fitted = _fit(name, used, distortion)
    left_out: list[View] = []
    while (worst := _outlying(fitted)) is not None:
        left_out.append(used.pop(worst))
        if len(used) < MIN_VIEWS or len(left_out) > MAX_LEFT_OUT * (len(used) + len(left_out)):
            names = ", ".join(view.name for view in left_out)
            raise ValueError(
                f"{where}: views must agree on one lens; {len(left_out)} of {len(used) + len(left_out)} "
                f"do not ({names}). Check that board and focus were never changed, and delete blurred images."
            )
        fitted = _fit(name, used, distortion)
    _check_fit(name, fitted)
    outside = []  # views that had no part in the calibration, with the poses that suit them best
    for view in left_out:
        _, rvec, tvec = cv2.solvePnP(view.points, view.pixels, fitted.camera.matrix, fitted.camera.distortion)
        outside.append(_fitted(fitted.camera, view, np.ravel(rvec), np.ravel(tvec)))
    return replace(fitted, left_out=tuple(outside), missed=missed)


def rms(residuals: Array) -> float:
    """px, root mean square length of residuals (n, 2) px."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def turn(normals: Array) -> float:
    """rad, the largest angle between two of the directions (n, 3)."""
    return float(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0)))


def coverage(size: tuple[int, int], pixels: Array) -> float:
    """Share of the cells of an image of `size` that contain any of pixels (n, 2)."""
    cells = np.clip((pixels + 0.5) / np.array(size) * CELLS, 0, np.array(CELLS) - 1).astype(int)
    return len(np.unique(cells, axis=0)) / (CELLS[0] * CELLS[1])


def _check_views(name: str, used: Sequence[View], missed: Sequence[str]) -> None:
    where = f"camera {shown(name)}"
    if len(used) < MIN_VIEWS:
        lack = f" No board (or hardly any of it) in {', '.join(missed)}." if missed else ""
        raise ValueError(
            f"{where}: at least {MIN_VIEWS} images must show the board; got {len(used)} of "
            f"{len(used) + len(missed)}.{lack} Check squares and kind of board, or take more, turned differently."
        )
    for view in used:
        if view.size != used[0].size:
            first, other = (f"{one.size[0]}x{one.size[1]}" for one in (used[0], view))
            raise ValueError(
                f"{where}: images must have one size; {used[0].name} has {first} and {view.name} {other} pixels. "
                "Take them all as the videos will be."
            )


def _fit(name: str, views: Sequence[View], distortion: int) -> Intrinsics:
    points = [np.ascontiguousarray(view.points, dtype=np.float32) for view in views]
    pixels = [np.ascontiguousarray(view.pixels, dtype=np.float32) for view in views]
    size = views[0].size
    try:
        with one_thread():
            _, matrix, coefficients, rvecs, tvecs = cv2.calibrateCamera(
                points, pixels, size, np.eye(3), np.zeros(0), flags=_FLAGS[distortion], criteria=_CRITERIA
            )
        bent = np.array(np.ravel(coefficients)[:distortion], dtype=np.float64)
        camera = Camera(name, size, np.array(matrix, dtype=np.float64), bent, np.zeros(3), np.zeros(3))
    except (cv2.error, ValueError):
        problem = f"camera {shown(name)}: views must tell the lens; no lens explains them"
        remedy = "Turn the board to different sides, up to 45 degrees, and check that it is flat."
        raise ValueError(f"{problem}. {remedy}") from None
    posed = zip(views, rvecs, tvecs, strict=True)
    fitted = tuple(_fitted(camera, view, np.ravel(rvec), np.ravel(tvec)) for view, rvec, tvec in posed)
    share = coverage(size, np.concatenate([view.pixels for view in views]))
    covariance = covariance_of_lens(camera, [(v.view.points, v.rvec, v.tvec, v.residuals) for v in fitted])
    return Intrinsics(camera, covariance, fitted, (), (), share)


def _fitted(camera: Camera, view: View, rvec: Array, tvec: Array) -> FittedView:
    projected, _ = cv2.projectPoints(view.points, rvec, tvec, camera.matrix, camera.distortion)
    return FittedView(view, rvec, tvec, view.pixels - np.asarray(projected, dtype=np.float64).reshape(-1, 2))


def _outlying(fitted: Intrinsics) -> int | None:
    errors = np.array([view.rms for view in fitted.views])
    worst = int(errors.argmax())
    return worst if errors[worst] > max(OUTLYING * float(np.median(errors)), MIN_OUTLYING) else None


def _check_fit(name: str, fitted: Intrinsics) -> None:
    where, turned = f"camera {shown(name)}", turn(np.stack([view.normal for view in fitted.views]))
    if turned < MIN_TURN:
        rule = f"boards must be turned against each other by {np.degrees(MIN_TURN):.0f} degrees or more"
        problem = f"{where}: {rule}; got {np.degrees(turned):.1f}"
        raise ValueError(f"{problem}. Parallel boards cannot tell the focal length: turn it all ways.")
    sigma = float((fitted.sigmas[:2] / fitted.camera.matrix[[0, 1], [0, 1]]).max())
    if not sigma <= MAX_FOCAL_SIGMA:
        problem = f"{where}: the focal length must be known to {100 * MAX_FOCAL_SIGMA:g} %; got {100 * sigma:.1f} %"
        raise ValueError(f"{problem}. Take more images, with the board near and turned to all sides, up to 45 degrees.")
    if fitted.coverage < MIN_COVERAGE:
        rule = f"corners must lie in {100 * MIN_COVERAGE:.0f} % of the image or more"
        problem = f"{where}: {rule}; got {100 * fitted.coverage:.0f} %"
        raise ValueError(f"{problem}. Take images with the board near all borders and corners of the image.")
    (sigma, _), coefficients = fitted.ray_sigma, len(fitted.camera.distortion)
    if not sigma <= MAX_RAY_SIGMA:
        rule = f"the lens must be known to {MAX_RAY_SIGMA:g} px in {RAYS:.0%} of the image; got {sigma:.1f} px"
        remedy = f"Take images with the board in its corners, or fewer coefficients than {coefficients}."
        raise ValueError(f"{where}: {rule}. {remedy}")
    camera, pixels = fitted.camera, pixel_grid(fitted.camera)
    directions = camera.directions(pixels)
    again = camera.project(directions)
    apart = float(np.linalg.norm(again - pixels, axis=1).max())
    if not apart <= MAX_FOLD or _has_pole(camera, float((directions[:, :2] ** 2).sum(axis=1).max())):
        rule = "the distortion must be possible to undo; it folds a part of the image"
        remedy = f"Take images with the board in all its corners, or fewer coefficients than {coefficients}."
        raise ValueError(f"{where}: {rule}. {remedy}")


def _has_pole(camera: Camera, limit: float) -> bool:
    """True if a rational distortion is infinite somewhere up to a squared radius of the plane at z = 1.

    Where a lens needs no denominator, it and the numerator share zeros, but not exactly.
    """
    if len(camera.distortion) < 8:
        return False
    zeros = np.roots([*camera.distortion[7:4:-1], 1.0])
    real = zeros[np.abs(zeros.imag) < 1e-9].real
    return bool(((real > 0.0) & (real < limit)).any())


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
    points = camera.directions(pixel_grid(camera))
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
