"""A calibrated camera follows OpenCV's pinhole model with distortion, and has a pose and a clock."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array, Mask
from ballfg.checks import check_array, check_name, check_number, shown

MOST_PIXELS: Final = 1_000_000  # largest number of px of one side of an image
DISTORTIONS: Final = (0, 4, 5, 8, 12, 14)
"""Lengths of distortion vectors in OpenCV: none; k1 k2 p1 p2; k3; k4 k5 k6; thin prism s1-s4; tilt tau_x tau_y."""
_PRECISELY: Final = (3, 60, 1e-12)  # cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
"""OpenCV undoes distortion by five steps of a fixed point by default: 0.1 pixel off in a wide lens."""
LONGEST: Final = 0.1  # s, of an exposure, and until all rows of an image are read
LATEST: Final = 1e11  # s, of a stamp: 3,000 years
WIDEST_ASKED: Final = 6.0  # tangent of the angle from the axis up to which a lens is tested: 80 degrees
WIDEST_STEPS: Final = 6001


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera. Arrays are copied and converted to float64; every field is checked.

    A point X (m, world) is seen at x = R X + t in the camera's frame (z forward, x right, y down), R the rotation of
    `rvec`; distortion and `matrix` turn x/z into pixels. The centre of the top left pixel is (0, 0).

    Raises: ValueError: a wrong shape, a number that is not finite, a matrix that is not a camera's; the message names
        camera and field. TypeError: a name that is not a str.

    Source: OpenCV, "Camera Calibration and 3D Reconstruction", detailed description.
    """

    name: str
    """Unique among the cameras of a rig."""
    size: tuple[int, int]
    """Width and height of the image, pixels."""
    matrix: Array
    """(3, 3) focal lengths and principal point, pixels: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    distortion: Array
    """(k,) dimensionless coefficients in OpenCV's order; k one of `DISTORTIONS`."""
    rvec: Array
    """(3,) rad, rotation vector from the world to the camera."""
    tvec: Array
    """(3,) m, the world's origin in the camera's frame."""
    time_offset: float = 0.0
    """s, delay of the camera's stamps: an event stamped t happened at t - time_offset."""
    covariance: Array | None = None
    """(7, 7) of the errors of turn (about the world's axes, rad), centre (m) and log focal length; None: exact."""
    readout: float = 0.0
    """s from the exposure of the first row to that of the last, of a rolling shutter; below 0 if the last is first. A
    stamp is that of the middle row."""
    exposure: float = 0.0
    """s, for which the shutter is open, a stamp its middle: a streak's ends are where the ball was then; 0: unknown."""

    def __post_init__(self) -> None:
        check_name("a camera's name", self.name)
        where = f"camera {shown(self.name)}"
        sides = check_array(f"{where}: size", self.size, (2,), "Give width and height in px.")
        if not ((sides > 0.0) & (sides <= MOST_PIXELS) & (sides % 1.0 == 0.0)).all():
            raise ValueError(f"{where}: size must be width and height in pixels; got {shown(self.size)}. Correct it.")
        width, height = int(sides[0]), int(sides[1])
        object.__setattr__(self, "size", (width, height))
        count = np.asarray(self.distortion).size
        if count not in DISTORTIONS:
            lengths = ", ".join(map(str, DISTORTIONS))
            what = f"{where}: distortion must have one of {lengths} coefficients; got {count}"
            raise ValueError(f"{what}. Give them in OpenCV's order k1, k2, p1, p2, k3, ...")
        for field, shape in {"matrix": (3, 3), "rvec": (3,), "tvec": (3,), "distortion": (count,)}.items():
            array = check_array(f"{where}: {field}", getattr(self, field), remedy=f"Give {shape} numbers.")
            if array.size != np.prod(shape, dtype=int):
                raise ValueError(f"{where}: {field} must have shape {shape}; got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{where}: {field} must be finite; got {array.tolist()}")
            array = array.reshape(shape)
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        k = self.matrix
        if not (k[0, 0] > 0 and k[1, 1] > 0 and k[1, 0] == 0 and (k[2] == (0, 0, 1)).all() and k[0, 1] == 0):
            rule = "matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0"
            raise ValueError(f"{where}: {rule}; got {k.tolist()}")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", _checked_covariance(where, self.covariance))
        offset = check_number(f"{where}: time_offset", self.time_offset, "s", limit=LATEST, instead="ns")
        object.__setattr__(self, "time_offset", offset)
        for field, least in (("readout", -LONGEST), ("exposure", 0.0)):
            seconds = check_number(f"{where}: {field}", getattr(self, field), "s")
            if not least <= seconds <= LONGEST:
                rule = f"{where}: {field} must be {least:g} to {LONGEST:g} s; got {seconds:g}"
                raise ValueError(f"{rule}. It is shorter than a frame; give seconds.")
            object.__setattr__(self, field, seconds)

    @cached_property
    def rotation(self) -> Array:
        """(3, 3) dimensionless, from the world to the camera."""
        import cv2  # a dataset without cameras needs none of it

        return np.asarray(cv2.Rodrigues(self.rvec)[0], dtype=np.float64)

    @cached_property
    def centre(self) -> Array:
        """(3,) m, position of the camera."""
        return np.asarray(-self.rotation.T @ self.tvec)

    @cached_property
    def widest(self) -> float:
        """Largest distance from the axis, in the plane at z = 1, up to which the projection grows monotonically.

        The polynomial of a distortion that was fitted within the image turns back somewhere outside of it; points
        beyond would reappear in the picture. Infinite for a lens that never turns back.
        """
        k1, k2, _, _, k3, k4, k5, k6 = np.pad(self.distortion, (0, 14 - len(self.distortion)))[:8]
        r = np.linspace(0.0, WIDEST_ASKED, WIDEST_STEPS)
        q = r * r
        bent = r * (1 + q * (k1 + q * (k2 + q * k3))) / (1 + q * (k4 + q * (k5 + q * k6)))
        back = np.flatnonzero(np.diff(bent) <= 0.0)
        return float(r[back[0]]) if len(back) else np.inf

    def true_times(self, stamps: Array, pixels: Array) -> Array:
        """(n,) s, at which the camera saw pixels (n, 2) of frames with stamps (n,) s."""
        late = 0.0 if self.readout == 0.0 else self.readout * ((pixels[:, 1] + 0.5) / self.size[1] - 0.5)
        return np.asarray(stamps - self.time_offset + late)

    def project(self, points: ArrayLike) -> Array:
        """Projects points to pixels.

        Args: points: (..., 3) m, world.
        Returns: (..., 2) px; NaN for points behind the camera or beyond its lens.
        """
        points = np.asarray(points, dtype=np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        if len(flat) == 0:
            return np.zeros((*points.shape[:-1], 2))
        import cv2

        pixels, _ = cv2.projectPoints(flat, self.rvec, self.tvec, self.matrix, self.distortion)
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        x, y, depth = (flat @ self.rotation.T + self.tvec).T
        pixels[~((depth > 0.0) & (np.hypot(x, y) <= self.widest * depth))] = np.nan
        return pixels.reshape(*points.shape[:-1], 2)

    def depth(self, points: ArrayLike) -> Array:
        """Distance along the viewing direction.

        Args: points: (..., 3) m, world.
        Returns: (...) m; negative behind the camera.
        """
        return np.asarray(points @ self.rotation[2] + self.tvec[2])

    def normalized(self, pixels: ArrayLike) -> Array:
        """Directions in the camera's frame, with the distortion undone.

        Args: pixels: (..., 2) px.
        Returns: (..., 2) x/z and y/z, dimensionless, of the points seen there.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
        if len(flat) == 0:
            return np.zeros(pixels.shape)
        import cv2

        plane = cv2.undistortPoints(flat, self.matrix, self.distortion, criteria=_PRECISELY)
        return np.asarray(plane, dtype=np.float64).reshape(pixels.shape)

    def directions(self, pixels: ArrayLike) -> Array:
        """(..., 3) dimensionless, of what is seen at pixels (..., 2), in the camera's frame, with z = 1."""
        plane = self.normalized(pixels)
        return np.concatenate((plane, np.ones((*plane.shape[:-1], 1))), axis=-1)

    def rays(self, pixels: ArrayLike) -> Array:
        """Rays from the camera's centre through pixels.

        Args: pixels: (..., 2) px.
        Returns: (..., 3) unit vectors, dimensionless, in the world.
        """
        directions = self.directions(pixels) @ self.rotation
        return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))

    def in_view(self, points: ArrayLike) -> Mask:
        """True for points in front of the camera and within its image.

        Args: points: (..., 3) m, world.
        Returns: (...) bool.
        """
        return self.holds(self.project(points))

    def holds(self, pixels: Array, reach: Array | float = 0.0) -> Mask:
        """(...) True for discs of radius `reach` (...) px about pixels (..., 2) within the image; False for NaN."""
        reach = np.asarray(reach)[..., None]
        return np.asarray(((pixels - reach >= -0.5) & (pixels + reach < np.array(self.size) - 0.5)).all(axis=-1))


def _checked_covariance(where: str, given: Array) -> Array:
    remedy = "Let 'ballfg calibrate-cameras' write it, or leave it out."
    array = check_array(f"{where}: covariance", given, (7, 7), remedy)
    whole = np.isfinite(array).all() and np.allclose(array, array.T, rtol=1e-6, atol=0.0)
    if not whole or np.linalg.eigvalsh(array).min() <= 0.0:
        raise ValueError(f"{where}: covariance must be symmetric and positive definite. {remedy}")
    array.setflags(write=False)
    return array
