"""Sightings are the pixels of one ball in several cameras, each with its own camera's stamp."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ballfg.arrays import Array
from ballfg.checks import check_array, check_iterable, check_name, shown

ROUNDING = 1e-6  # relative to the trace: tolerance for the symmetry of a covariance from single precision


@dataclass(frozen=True, eq=False)
class Sightings:
    """The sightings of one ball, rows in order of true time. Arrays are copied; every field is checked.

    A camera sees a ball once in a frame, so the stamps of each camera increase. Stamps of different cameras have clocks
    of their own and are not compared.

    Raises: ValueError: a wrong shape, a number that is not finite, a camera's number out of range, stamps of one camera
        that do not increase, a covariance that is not symmetric and positive definite; the message names the row.
    """

    cameras: tuple[str, ...]  # names of the rig's cameras, including those without a sighting
    camera: NDArray[np.int64]  # (m,) number of each sighting's camera: an index into `cameras`
    times: Array  # (m,) s, stamps as recorded by the camera
    pixels: Array  # (m, 2) px, place of the ball's centre in the middle of the exposure
    covariances: Array  # (m, 2, 2) px^2
    radii: Array | None = None
    """(m, 2) px, radius of the ball in the picture, 0 where unknown, and its standard deviation; None: all unknown."""
    streaks: Array | None = None
    """(m, 2) px, from one end of the ball's streak to the other, either way, 0 where unknown; None: all unknown."""
    shifts: Array | None = None
    """(m, 3) m, where the camera stood from its own place, along the world's axes; None: no camera moved."""

    def __post_init__(self) -> None:
        check_iterable("cameras", self.cameras)
        names = tuple(self.cameras)
        for name in names:
            check_name("a name of cameras", name)
        if not names or len(set(names)) < len(names):
            raise ValueError(f"cameras must be different names, at least one; got {list(names)}. Rename or add some.")
        object.__setattr__(self, "cameras", names)
        times = check_array("times", self.times, remedy="Pass one row per sighting.")
        if times.ndim != 1 or len(times) == 0:
            raise ValueError(f"times must have shape (m,) with m >= 1; got {times.shape}. Pass one stamp per sighting.")
        m = len(times)
        camera = np.asarray(self.camera)
        if camera.shape != (m,) or camera.dtype.kind not in "iu" or not ((camera >= 0) & (camera < len(names))).all():
            problem = f"camera must be ({m},) whole numbers from 0 to {len(names) - 1}; got {shown(camera.tolist())}"
            raise ValueError(f"{problem}. Number the cameras in the order of their names.")
        object.__setattr__(self, "camera", camera.astype(np.int64))
        self._check_arrays(m)
        for number, name in enumerate(self.cameras):
            rows = np.flatnonzero(self.camera == number)
            wrong = np.flatnonzero(np.diff(self.times[rows]) <= 0.0)
            if wrong.size:
                first, second = (int(row) for row in rows[wrong[0] : wrong[0] + 2])
                raise ValueError(
                    f"times of camera {shown(name)} must increase; times[{second}]={self.times[second]} <= "
                    f"times[{first}]={self.times[first]}. Sort the rows, and keep one sighting a frame."
                )
        good = are_covariances(self.covariances)
        if not good.all():
            row = int(np.argmin(good))
            raise ValueError(
                f"covariances must be symmetric and positive definite; covariances[{row}]="
                f"{self.covariances[row].tolist()}. Give the variance of u and v in px^2."
            )

    def _check_arrays(self, m: int) -> None:
        """Checks and converts the arrays of numbers of m sightings. Raises: ValueError."""
        for field, shape, remedy in (
            ("times", (m,), "Drop that sighting"),
            ("pixels", (m, 2), "Drop that sighting"),
            ("covariances", (m, 2, 2), "Drop that sighting"),
            ("streaks", (m, 2), "Give 0 for unknown"),
            ("shifts", (m, 3), "Give 0 for none"),
        ):
            if field in ("streaks", "shifts") and getattr(self, field) is None:
                continue
            array = check_array(field, getattr(self, field), shape, "Pass one row per sighting.")
            if not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0][0])
                raise ValueError(f"{field} must be finite; {field}[{row}]={array[row].tolist()}. {remedy}.")
            object.__setattr__(self, field, array)
        if self.radii is not None:
            radii = check_array("radii", self.radii, (m, 2), "Pass one row per sighting.")
            good = np.isfinite(radii).all(axis=1) & (radii[:, 0] >= 0.0) & (radii[:, 1] > 0.0)
            if not good.all():
                row = int(np.argmin(good))
                problem = f"radii must be a radius and a sigma above zero, in px; radii[{row}]={radii[row].tolist()}"
                raise ValueError(f"{problem}. Give 0 for an unknown radius.")
            object.__setattr__(self, "radii", radii)

    def __len__(self) -> int:
        return len(self.times)

    def from_cameras(self, points: Array) -> Array:
        """(m, 3) m, of points (m, 3) m, where they would be if every camera were at its own place and saw the same."""
        return points if self.shifts is None else points - self.shifts

    def select(self, rows: ArrayLike) -> "Sightings":
        """The rows of the numbers (k,), ascending, or of the mask (m,) bool. Raises: ValueError: if none remains."""
        kept = np.asarray(rows)
        cues = (None if cue is None else cue[kept] for cue in (self.radii, self.streaks, self.shifts))
        own = (self.camera[kept], self.times[kept], self.pixels[kept], self.covariances[kept])
        return Sightings(self.cameras, *own, *cues)


def are_covariances(matrices: Array) -> NDArray[np.bool_]:
    """(n,) True for matrices (n, 2, 2) that are symmetric, up to `ROUNDING`, and positive definite."""
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    symmetric = np.abs(matrices[:, 1, 0] - b) <= ROUNDING * (a + c)
    return np.asarray(symmetric & (a > 0.0) & (c > 0.0) & (a * c > b * b))
