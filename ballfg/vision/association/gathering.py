"""Gathers the candidates of a ball from all cameras and makes its points in space on one clock."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.tracks.sightings import Sightings
from ballfg.vision.association.paths import Path, path
from ballfg.vision.association.triangulate import triangulate
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

SAME_SHUTTER: Final = 2e-4  # s, largest difference between stamps of one shutter: at 15 m/s the ball moves 3 mm


@dataclass(frozen=True, eq=False)
class Footage:
    """A recording of all cameras, on one clock that begins with the first frame of all."""

    cameras: Sequence[Camera]
    detections: Sequence[Detections]  # one for each camera, in the cameras' order
    shared: Array | None  # (k,) s, true time of the stamps if the cameras share a shutter
    origin: float = 0.0  # s, stamp of the first frame of all; the detections' stamps are counted from it
    stamps: Sequence[Array] = ()  # for each camera (f,) s, the recorded stamps of its frames
    offset: float = 0.0  # px, error of the calibration, added to every pixel's noise

    def frames(self, camera: int) -> Array:
        """(f,) s, true times of a camera's frames."""
        return np.asarray(self.detections[camera].frames - self.cameras[camera].time_offset)

    def path(self, camera: int, rows: Index) -> Path:
        """Candidates of one camera as a path over true time."""
        seen = self.detections[camera]
        return path(self.frames(camera)[seen.frame[rows]], seen.pixels[rows], seen.covariances[rows])


@dataclass(frozen=True, eq=False)
class Gathered:
    """A ball during the association."""

    rows: tuple[Index, ...]  # for each camera the numbers of its candidates, ascending; never two of one frame
    track: Path  # its points in space over true time, with the covariances that noise gives them
    covariances: Array  # (n, 3, 3) m^2, including the calibration's error
    views: Index  # (n,) cameras that made each point


@dataclass(frozen=True, eq=False)
class SeenBall:
    """One ball's track, in order of time."""

    times: Array
    """(n,) s, true time."""
    points: Array
    """(n, 3) m, world."""
    covariances: Array
    """(n, 3, 3) m^2, of each point by itself; interpolated points share samples and so a little of their error."""
    sightings: Sightings
    """The sightings behind the points, each at its own camera's stamp."""
    views: Index
    """(n,) number of cameras that made each point."""

    def __len__(self) -> int:
        return len(self.times)


def gather(footage: Footage, rows: Sequence[Index]) -> Gathered:
    """The points of the cameras' candidates, one a frame at most, ascending; none if fewer than two agree."""
    # stamps of the shared shutter, or of the camera that saw most
    stamps = footage.frames(int(np.argmax(list(map(len, rows))))) if footage.shared is None else footage.shared
    seen = [footage.frames(c)[footage.detections[c].frame[mine[[0, -1]]]] for c, mine in enumerate(rows) if len(mine)]
    first, last = (np.min(seen), np.max(seen)) if seen else (np.inf, -np.inf)
    times = np.asarray(stamps[(stamps >= first - SAME_SHUTTER) & (stamps <= last + SAME_SHUTTER)])
    pixels = np.full((len(times), len(rows), 2), np.nan)
    covariances = np.full((len(times), len(rows), 2, 2), np.nan)
    for camera, mine in enumerate(rows):
        if len(mine) and len(times):
            pixels[:, camera], covariances[:, camera] = footage.path(camera, mine).at(times)
    made = triangulate(footage.cameras, pixels, covariances + footage.offset**2 * np.eye(2))
    found = np.isfinite(made.points).all(axis=1)
    used = made.used[found]
    noise = np.trace(covariances[found], axis1=2, axis2=3) / 2.0
    share = np.mean(noise / (noise + footage.offset**2), axis=1, where=used)
    track = path(times[found], made.points[found], made.covariances[found] * share[:, None, None])
    return Gathered(tuple(rows), track, made.covariances[found], used.sum(axis=1).astype(np.int64))


def nearest(stamps: Array, times: Array) -> NDArray[np.intp]:
    """(k,) for each time the number of the nearest of n >= 1 ascending stamps; the earlier of two equally near."""
    after = np.clip(np.searchsorted(stamps, times), 1, max(len(stamps) - 1, 1))
    after = np.minimum(after, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(times - stamps[before] <= stamps[after] - times, before, after)


def shared_stamps(frames: Sequence[Array], within: float) -> Array | None:
    """The stamps of a shared shutter, all cameras' together, each once; None without one.

    They share a shutter if most frames of the camera with fewer frames, of every two, lie within `within` s of one of
    the other's. Frames may be missing anywhere, and one camera may take every second frame only.

    Args: frames: (f,) s of each camera, ascending, on one clock.
    Returns: (k,) s, or None.
    """
    for one, other in product(frames, frames):
        if 0 < len(one) <= len(other) and np.median(np.abs(other[nearest(other, one)] - one)) > within:
            return None
    stamps = np.sort(np.concatenate(frames))
    if not len(stamps):
        return None
    group = np.concatenate(([0], np.cumsum(np.diff(stamps) > within)))
    return np.asarray(np.bincount(group, stamps) / np.bincount(group))
