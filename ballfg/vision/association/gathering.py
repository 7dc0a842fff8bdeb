"""Gathers the candidates of a ball from all cameras, makes its points in space on one clock, and completes them.

Unassigned candidates near a ball's predicted track are added, between its own candidates and at the ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index, Mask
from ballfg.tracks.sightings import Sightings
from ballfg.vision.association.paths import Path, path
from ballfg.vision.association.triangulate import Triangulated, triangulate
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

SAME_SHUTTER: Final = 2e-4  # s, largest difference between stamps of one shutter: at 15 m/s the ball moves 3 mm
_GATE: Final = 16.0  # largest squared distance from the prediction, whitened: 4 sigma
_WIDEST: Final = 20.0  # px, largest sigma of a prediction that is used
_AHEAD: Final = 2.5  # frames by which a track is continued past its ends in one round
_ROUNDS: Final = 4  # most rounds; each reaches a little farther at the ends
_STEP: Final = 1e-3  # m, step of the numerical derivative of the projection
_SYSTEMATIC: Final = 1.0  # px, added to a prediction's sigma for the calibration of the cameras that it comes from


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
        """(f,) s, true times of a camera's frames, in their middle rows."""
        return np.asarray(self.detections[camera].frames - self.cameras[camera].time_offset)

    def times(self, camera: int, rows: Index) -> Array:
        """(n,) s, true times of candidates of one camera."""
        seen = self.detections[camera]
        return self.cameras[camera].true_times(seen.times[rows], seen.pixels[rows])

    def path(self, camera: int, rows: Index) -> Path:
        """Candidates of one camera as a path over true time."""
        seen = self.detections[camera]
        return path(self.times(camera, rows), seen.pixels[rows], seen.covariances[rows])


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

    times: Array  # (n,) s, true time
    points: Array  # (n, 3) m, world
    covariances: Array
    """(n, 3, 3) m^2, of each point by itself; interpolated points share samples and so a little of their error."""
    sightings: Sightings  # the sightings behind the points, each at its own camera's stamp
    views: Index  # (n,) number of cameras that made each point

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
    noisy = covariances + footage.offset**2 * np.eye(2)
    made = triangulate(footage.cameras, pixels, noisy)
    found: NDArray[np.bool_] = np.asarray(np.isfinite(made.points).all(axis=1))
    used = made.used[found]
    noise = np.trace(covariances[found], axis1=2, axis2=3) / 2.0
    share = np.mean(noise / (noise + footage.offset**2), axis=1, where=used)
    track = path(times[found], made.points[found], made.covariances[found] * share[:, None, None])
    spread: Array = made.covariances[found] + _of_cameras(footage.cameras, made.rows(found), noisy[found])
    return Gathered(tuple(rows), track, spread, used.sum(axis=1).astype(np.int64))


def _of_cameras(cameras: Sequence[Camera], made: Triangulated, noise: Array) -> Array:
    """(n, 3, 3) m^2, what the covariances of the cameras add to those of points, all of which exist.

    A change of a camera moves its pixels, and a pixel moves the point by its gain P J' R^-1.

    Args: noise: (n, c, 2, 2) px^2 of the pixels.
    """
    spread = np.zeros(made.covariances.shape)
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(made.used[:, number])
        if camera.covariance is None or not len(rows):
            continue
        from ballfg.vision.projection import by_changes  # with torch, which exact cameras need not load

        by_point, by_change = by_changes(camera, made.points[rows])
        gain = made.covariances[rows] @ by_point.swapaxes(1, 2) @ np.linalg.inv(noise[rows, number])
        moved = gain @ by_change
        spread[rows] += moved @ camera.covariance @ moved.swapaxes(1, 2)
    return spread


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


def complete(footage: Footage, balls: Sequence[Gathered]) -> list[Gathered]:
    """The balls with the unassigned candidates that fit them; one that fits two balls stays unassigned."""
    done = list(balls)
    taken = [np.zeros(len(seen), dtype=bool) for seen in footage.detections]
    for ball in balls:
        for camera, rows in enumerate(ball.rows):
            taken[camera][rows] = True
    for _ in range(_ROUNDS):
        wanted = [_wanted(footage, ball, taken) for ball in done]
        for camera, free in enumerate(taken):
            claims = np.zeros(len(free), dtype=int)
            for want in wanted:
                claims[want[camera]] += 1
            for want in wanted:
                want[camera] = want[camera][claims[want[camera]] == 1]
                free[want[camera]] = True
        changed = [number for number, want in enumerate(wanted) if any(len(rows) for rows in want)]
        for number in changed:
            both = zip(done[number].rows, wanted[number], strict=True)
            done[number] = gather(footage, [np.union1d(old, new) for old, new in both])
        if not changed:
            break
    return done


def _wanted(footage: Footage, ball: Gathered, taken: Sequence[Mask]) -> list[Index]:
    """For each camera the unassigned candidates near the ball's predicted track."""
    wanted = []
    for number, camera in enumerate(footage.cameras):
        seen = footage.detections[number]
        frames = footage.frames(number)
        ahead = _AHEAD * float(np.median(np.diff(frames))) if len(frames) > 1 else 0.0
        near = (frames >= ball.track.times[0] - ahead) & (frames <= ball.track.times[-1] + ahead)
        near[seen.frame[ball.rows[number]]] = False
        free = np.flatnonzero(near[seen.frame] & ~taken[number])
        pixels, spread = _predicted(camera, ball, footage.times(number, free))
        spread = spread + seen.covariances[free] + (footage.offset**2 + _SYSTEMATIC**2) * np.eye(2)
        sure = np.asarray(np.isfinite(pixels).all(axis=1))
        sure[sure] = np.trace(spread[sure], axis1=1, axis2=2) <= 2.0 * _WIDEST**2
        apart = seen.pixels[free[sure]] - pixels[sure]
        square = np.einsum("ni,ni->n", apart, np.linalg.solve(spread[sure], apart[..., None])[..., 0])
        fits = free[sure][square <= _GATE]
        frame, count = np.unique(seen.frame[fits], return_counts=True)
        wanted.append(fits[np.isin(seen.frame[fits], frame[count == 1])])
    return wanted


def _predicted(camera: Camera, ball: Gathered, times: Array) -> tuple[Array, Array]:
    """Predicted pixels (k, 2) of the ball at times (k,), and their covariances (k, 2, 2); NaN if unknown."""
    points, spread = ball.track.at(times)
    for late, outside in ((False, times < ball.track.times[0]), (True, times > ball.track.times[-1])):
        points[outside], spread[outside] = ball.track.beyond(times[outside], last=late)
    pixels = camera.project(points)
    steps = [(camera.project(points + step) - pixels) / _STEP for step in _STEP * np.eye(3)]
    slopes = np.stack(steps, axis=-1) if len(points) else np.zeros((0, 2, 3))
    return pixels, slopes @ spread @ np.swapaxes(slopes, 1, 2)
