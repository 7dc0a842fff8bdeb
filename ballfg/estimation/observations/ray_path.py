"""Computes a rough path from sightings, at each moment by a short parabola through the rays around it.

A ray gives two linear equations of a point on it, so a free fall p + v t + g t^2 / 2 is a linear least-squares problem
in (p, v) over the sightings of any cameras at any times: nothing is interpolated, and cameras need no common shutter.
Windows lie around, before and after the moment; the one with the smallest expected error counts, its own residuals
included, so that the chosen window holds no bounce. A window of one camera alone does not count: all points on its rays
fit, those at the camera best.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.state import STANDARD_GRAVITY, Z
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera import Camera

AROUND: Final = ((-1.6, 1.6), (-2.2, 0.0), (0.0, 2.2), (-1.2, 0.0), (0.0, 1.2))
"""Windows about a moment, in periods of the slowest camera: each holds two sightings or more of every camera."""
BEFORE: Final = ((-3.2, 0.0), (-2.2, 0.0), (-1.2, 0.0))  # Windows for a stream, without later sightings
LEAST_SPARE: Final = 2
"""Least number of equations beyond the six unknowns, for residuals to show a bounce within a window."""
ROUNDS: Final = 4  # Solutions of a window: the first assumes equal depths, the others weight wrong candidates down
ROBUST: Final = 5.0  # Scale of Cauchy's loss on a sighting, in standard deviations of its noise
SPEED: Final = 30.0
"""m/s, prior standard deviation of the velocity: bounds the direction that a single camera leaves undetermined."""
SPREAD: Final = 100.0  # m, prior standard deviation of the position about the cameras
NEAREST: Final = 0.05  # m, least depth that a ball may have while its window is solved
LOOSE: Final = 0.05  # m. If the rays at a moment leave the position more uncertain, its neighbours in time replace it
LOOSE_SIGMA: Final = 0.1
"""m, standard deviation of a position that was interpolated in time: a bounce may lie between its neighbours."""
LOOSE_GROWTH: Final = 2.0
"""m/s, growth of that with the time to the next determined moment: the error of a window's velocity."""


@dataclass(frozen=True)
class Path:
    """Positions (n, 3) m at some moments, velocities (n, 3) m/s, and sigmas (n, 3) m, with misfits in them."""

    positions: Array
    velocities: Array
    sigmas: Array

    def joined(self, other: "Path") -> "Path":
        """This path, then another."""
        return Path(*(np.concatenate((getattr(self, f.name), getattr(other, f.name))) for f in fields(self)))


@dataclass(frozen=True)
class Rays:
    """Sightings as linear equations A X = b of the ball's position, in units of x/z and y/z times depth."""

    times: Array  # (m,) s, true, ascending
    camera: Index  # (m,) number of the camera
    matrix: Array  # (m, 2, 3)
    target: Array  # (m, 2)
    root: Array  # (m, 2, 2) whitens a residual divided by the depth
    depth_row: Array  # (m, 4): depth = row[:3] X + row[3]
    period: float  # s, of the slowest camera

    @classmethod
    def of(cls, sightings: Sightings, times: Array, cameras: Sequence[Camera]) -> "Rays":
        """The rays of sightings, with their true times (m,) s and the cameras in the order of their numbers."""
        m = len(sightings)
        plane, root = np.empty((m, 2)), np.linalg.inv(np.linalg.cholesky(sightings.covariances))
        rotation = np.stack([camera.rotation for camera in cameras])[sightings.camera]
        tvec = np.stack([camera.tvec for camera in cameras])[sightings.camera]
        if sightings.shifts is not None:
            tvec = tvec - (rotation @ sightings.shifts[..., None])[..., 0]
        periods = []
        for number, camera in enumerate(cameras):
            (rows,) = np.nonzero(sightings.camera == number)
            plane[rows] = camera.normalized(sightings.pixels[rows])
            root[rows] = root[rows] @ camera.matrix[:2, :2]
            periods += [float(np.median(np.diff(times[rows])))] if len(rows) > 1 else []
        matrix = rotation[:, :2] - plane[..., None] * rotation[:, 2:]
        target = plane * tvec[:, 2:] - tvec[:, :2]
        depth_row = np.concatenate((rotation[:, 2], tvec[:, 2:]), axis=1)
        return cls(times, sightings.camera, matrix, target, root, depth_row, max(periods, default=0.0))

    def thinned(self, most: int) -> "Rays":
        """At most so many of these rays, evenly chosen."""
        every = -(-len(self.times) // most)
        arrays = {f.name: getattr(self, f.name)[::every] for f in fields(self) if f.name != "period"}
        return replace(self, **arrays, period=every * self.period)

    def joined(self, later: "Rays", most: int, period: float) -> "Rays":
        """These rays and later ones, the newest `most` of them, with a new period, s."""
        arrays = [f.name for f in fields(self) if f.name != "period"]
        both = {name: np.concatenate((getattr(self, name), getattr(later, name)))[-most:] for name in arrays}
        return replace(self, **both, period=period)


def rough_path(rays: Rays, moments: Array, windows: Sequence[tuple[float, float]] = AROUND) -> Path:
    """The ball's positions at moments (n,) s, by the best of several windows around each.

    Args:
        rays: of all sightings that may be used.  moments: s.
        windows: begin and end of each about the moment, in periods of the slowest camera.
    """
    sides = np.array(windows) * rays.period
    found = _parabolas(rays, np.tile(moments, len(sides)), *np.repeat(sides.T, len(moments), axis=1))
    best = np.argmin(found.sigmas.max(axis=1).reshape(len(sides), -1), axis=0)
    rows = best * len(moments) + np.arange(len(moments))
    return Path(found.positions[rows], found.velocities[rows], found.sigmas[rows])


def _parabolas(rays: Rays, moments: Array, begin: Array, end: Array) -> Path:
    """The free falls through the sightings from begin (n,) to end (n,) s about moments (n,) s."""
    slack = 1e-3 * rays.period  # a sighting at the very end of a window belongs to it
    low = np.searchsorted(rays.times, moments + begin - slack)
    high = np.searchsorted(rays.times, moments + end + slack)
    rows = low[:, None] + np.arange(max(int((high - low).max()), 1))
    inside = rows < high[:, None]
    rows = np.minimum(rows, len(rays.times) - 1)
    since = rays.times[rows] - moments[:, None]
    matrix = rays.matrix[rows]
    fall = 0.5 * STANDARD_GRAVITY * since**2
    target = rays.target[rows] + matrix[..., Z] * fall[..., None]
    equations = np.concatenate((matrix, matrix * since[..., None, None]), axis=-1)
    unknown, covariance, misfit = _robust(rays, rows, inside, equations, target, since)
    spare = 2 * inside.sum(axis=1) - 6
    camera = rays.camera[rows]
    several = (inside & (camera != camera[:, :1])).any(axis=1)
    scale = np.where((spare >= LEAST_SPARE) & several, np.maximum(misfit / np.maximum(spare, 1), 1.0), np.inf)
    sigmas = np.sqrt(scale[:, None] * np.diagonal(covariance, axis1=1, axis2=2)[:, :3])
    return Path(unknown[:, :3], unknown[:, 3:], sigmas)


def _robust(
    rays: Rays, rows: Index, inside: NDArray[np.bool_], equations: Array, target: Array, since: Array
) -> tuple[Array, Array, Array]:
    """Solutions (n, 6) by reweighted least squares, covariances (n, 6, 6), twice the sum of the losses (n,)."""
    prior = np.diag([SPREAD**-2.0] * 3 + [SPEED**-2.0] * 3)
    count = rows.shape[1]
    base, depth_row = rays.root[rows], rays.depth_row[rows]
    depth, weight = np.ones(inside.shape), inside.astype(np.float64)
    for _ in range(ROUNDS):
        root = base / depth[..., None, None]
        whitened = (root @ equations).reshape(-1, 2 * count, 6)
        wanted = (root @ target[..., None]).reshape(-1, 2 * count, 1)
        pulled = whitened.swapaxes(1, 2) * np.repeat(weight, 2, axis=1)[:, None]
        information = pulled @ whitened + prior
        unknown = np.linalg.solve(information, pulled @ wanted)
        square = ((whitened @ unknown - wanted) ** 2).reshape(-1, count, 2).sum(axis=-1)
        weight = inside / (1.0 + square / ROBUST**2)
        point = unknown[:, None, :3, 0] + since[..., None] * unknown[:, None, 3:, 0]
        depth = np.maximum((depth_row[..., :3] * point).sum(axis=-1) + depth_row[..., 3], NEAREST)
    loss = ROBUST**2 * (np.log1p(square / ROBUST**2) * inside).sum(axis=1)
    return np.asarray(unknown[..., 0]), np.asarray(np.linalg.inv(information)), np.asarray(loss)


def determined(path: Path) -> NDArray[np.bool_]:
    """(n,) True where the rays around a moment determine the position."""
    return np.asarray(path.sigmas.max(axis=1) <= LOOSE)


def filled(moments: Array, path: Path) -> Path:
    """The path at moments (n,) s, with undetermined positions interpolated in time and extrapolated at its ends."""
    firm = determined(path)
    if firm.all():
        return path
    (at,), (gaps,) = np.nonzero(firm), np.nonzero(~firm)
    place = np.searchsorted(at, gaps)
    before, after = at[np.maximum(place - 1, 0)], at[np.minimum(place, len(at) - 1)]
    since, until = moments[gaps] - moments[before], moments[after] - moments[gaps]
    whole = since + until
    share = np.where(whole > 0.0, since / np.where(whole > 0.0, whole, 1.0), 0.0)[:, None]
    share = share**2 * (3.0 - 2.0 * share)  # Hermite's blend of the two extrapolations: smooth at both ends
    positions, velocities, sigmas = path.positions.copy(), path.velocities.copy(), path.sigmas.copy()
    positions[gaps] = (1 - share) * _fallen(path, before, since) + share * _fallen(path, after, -until)
    velocities[gaps] = (1 - share) * path.velocities[before] + share * path.velocities[after]
    nearest = np.minimum(np.abs(since), np.abs(until))
    nearest = np.where(before == after, np.maximum(np.abs(since), np.abs(until)), nearest)
    sigmas[gaps] = (LOOSE_SIGMA + LOOSE_GROWTH * nearest)[:, None]
    return Path(positions, velocities, sigmas)


def _fallen(path: Path, rows: NDArray[np.int64], elapsed: Array) -> Array:
    """(k, 3) m, positions of the free fall from some moments after some time, s."""
    points = path.positions[rows] + elapsed[:, None] * path.velocities[rows]
    points[:, Z] -= 0.5 * STANDARD_GRAVITY * elapsed**2
    return points
