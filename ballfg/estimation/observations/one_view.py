"""Finds the path of a ball that was seen from one point: a bounce and gravity give the depth that rays lack.

At a guessed time the ball bounces where the ray then meets a surface, with a flight on either side. Each sighting gives
two equations that are linear in the place of the bounce (2 unknowns) and in the velocities before and after it (6); the
times are scanned, and the smallest misfit counts. Without a bounce, gravity gives the scale: a flight is linear in its
position and velocity. Drag stretches a flight's time to ln(1 + k v s) / (k v), with the speed v of the last solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.ray_path import NEAREST, ROBUST, ROUNDS, SPREAD, Path, Rays
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Contact
from ballfg.state import Z

STEPS: Final = 0.25
"""Of the camera's period, between guessed times of a bounce; the smoother finds the time itself."""
SPEED: Final = 15.0
"""m/s, prior standard deviation of each component of a velocity."""
KEPT: Final = 0.8
"""Share of the horizontal velocity that a bounce leaves; friction takes or adds some."""
FRICTION_SIGMA: Final = 1.0
"""m/s, standard deviation about it: the spin is unknown."""
RESTITUTION_SIGMA: Final = 0.15
"""m/s, of the vertical velocity after a bounce."""
PRICE: Final = 10.0
"""Twice the log likelihood that a bounce must gain over a flight without one."""
PLANE_SIGMA: Final = 1e-3
"""m, of the height at which a ball bounces."""
ASIDE: Final = 0.1
"""m beside the table where a bounce may seem to be."""
STRETCH_LIMIT: Final = -0.8
"""Least k v s: before that the ball would have come from infinity."""


@dataclass(frozen=True)
class OneView:
    """The path of a ball at the moments of its track, and its bounce.

    Attributes:
        path: positions, velocities and sigmas.  bounce: s, time of the bounce, or None.
        height: m, declared height of the surface there.  misfit: twice the sum of losses of sightings and priors.
    """

    path: Path
    bounce: float | None
    height: float
    misfit: float

    def contact(self, times: Array) -> Contact | None:
        """The bounce between two of the samples at times (n,) s; None without one."""
        if self.bounce is None:
            return None
        interval = int(np.clip(np.searchsorted(times, self.bounce, side="right") - 1, 0, len(times) - 2))
        return Contact(interval, self.bounce, self.height)


@dataclass(frozen=True)
class _Flights:
    """Solutions about k guessed times, s: misfits (k,), unknowns (k, 9), covariances (k, 9, 9)."""

    times: Array
    bounces: bool
    misfit: Array
    unknown: Array
    covariance: Array


def one_view(rays: Rays, moments: Array, physics: SegmentationPhysics, surfaces: Surfaces) -> OneView:
    """The most likely path with one bounce or none.

    Args: rays: of all sightings.  moments: (n,) s, of the track's samples.  physics: of the ball.  surfaces: to meet.
    """
    middle = np.array([float(np.median(rays.times))])
    best, chosen, height = _solved(rays, middle, None, physics), 0, 0.0
    least = float(best.misfit[0])
    step = STEPS * rays.period
    guesses = np.arange(rays.times[0] + step, rays.times[-1] - 0.5 * step, step) if step > 0.0 else middle[:0]
    for place, level in enumerate(surfaces.heights() if len(guesses) else ()):
        plane = level + physics.radius + physics.surface_offset
        tried = _solved(rays, guesses, plane, physics)
        possible = _possible(tried, surfaces if place == 0 else None)
        row = int(np.argmin(np.where(possible, tried.misfit, np.inf)))
        if possible[row] and tried.misfit[row] + PRICE < least:
            best, chosen, height = tried, row, level
            break  # on the floor only what cannot be on the table: farther away and faster both look alike
    path = _path(best, chosen, moments, physics, len(rays.times))
    return OneView(path, float(best.times[chosen]) if best.bounces else None, height, float(best.misfit[chosen]))


def _solved(rays: Rays, guesses: Array, plane: float | None, physics: SegmentationPhysics) -> _Flights:
    """The flights through a point at guessed times (k,) s, which lies at height `plane` m; None: anywhere, no bounce.

    The unknowns are the point and the velocities before and after; without a bounce the last one counts nowhere.
    """
    prior, target = _priors(plane, physics)
    k, m = len(guesses), len(rays.times)
    since = rays.times - guesses[:, None]
    later = (since > 0.0) & (plane is not None)
    speed, depth, weight = np.zeros((k, m)), np.ones((k, m)), np.ones((k, m))
    matrix = rays.matrix
    wanted = rays.target + matrix[..., Z] * (0.5 * physics.gravity * since**2)[..., None]
    for _ in range(ROUNDS):
        span = _stretched(since, physics.drag * speed)
        moved = matrix * span[..., None, None]
        equations = np.concatenate(
            (
                np.broadcast_to(matrix, moved.shape),
                np.where(later[..., None, None], 0.0, moved),
                np.where(later[..., None, None], moved, 0.0),
            ),
            axis=-1,
        )
        root = rays.root / depth[..., None, None]
        whitened = (root @ equations).reshape(k, 2 * m, 9)
        side = (root @ wanted[..., None]).reshape(k, 2 * m)
        pulled = whitened.swapaxes(1, 2) * np.repeat(weight, 2, axis=1)[:, None]
        information = pulled @ whitened + prior.T @ prior
        unknown = np.linalg.solve(information, pulled @ side[..., None] + (prior.T @ target)[:, None])[..., 0]
        square = ((whitened @ unknown[..., None])[..., 0] - side).reshape(k, m, 2)
        square = (square**2).sum(axis=-1)
        weight = 1.0 / (1.0 + square / ROBUST**2)
        start = np.where(later[..., None], unknown[:, None, 6:], unknown[:, None, 3:6])
        speed = np.minimum(np.linalg.norm(start, axis=-1), 2.0 * SPEED)
        point = unknown[:, None, :3] + start * span[..., None]
        point[..., Z] -= 0.5 * physics.gravity * since**2
        depth = np.maximum((rays.depth_row[:, :3] * point).sum(axis=-1) + rays.depth_row[:, 3], NEAREST)
    loss = ROBUST**2 * np.log1p(square / ROBUST**2).sum(axis=1)
    misfit = loss + ((unknown @ prior.T - target) ** 2).sum(axis=1)
    return _Flights(guesses, plane is not None, misfit, unknown, np.linalg.inv(information))


def _priors(plane: float | None, physics: SegmentationPhysics) -> tuple[Array, Array]:
    """Whitened rows (r, 9) and their targets (r,): wide priors; with a bounce, its plane and its laws."""
    wide = np.diag([1.0 / SPREAD] * 3 + [1.0 / SPEED] * 6)
    if plane is None:
        return wide, np.zeros(9)
    laws, target = np.zeros((4, 9)), np.zeros(13)
    before, after = np.eye(3, 9, 3), np.eye(3, 9, 6)
    laws[0, Z], target[9] = 1.0 / PLANE_SIGMA, plane / PLANE_SIGMA
    laws[1:3] = (after[:2] - KEPT * before[:2]) / FRICTION_SIGMA
    laws[3] = (after[2] + physics.restitution * before[2]) / RESTITUTION_SIGMA
    return np.concatenate((wide, laws)), target


def _stretched(since: Array, drag: Array) -> Array:
    """(k, m) s: the time in which a ball without drag covers the same way, for drag k v (k, m) 1/s."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(drag > 0.0, np.log1p(np.maximum(drag * since, STRETCH_LIMIT)) / drag, since)


def _possible(tried: _Flights, table: Surfaces | None) -> NDArray[np.bool_]:
    """(k,) True for bounces from above, within the ends of the table if one is given."""
    x, y, falls, rises = (tried.unknown[:, i] for i in (0, 1, 5, 8))
    fine = (falls < 0.0) & (rises > 0.0)
    if table is not None and table.extent is not None:
        ends = np.array(table.extent) + ASIDE * np.array((-1.0, 1.0, -1.0, 1.0))
        fine &= (x >= ends[0]) & (x <= ends[1]) & (y >= ends[2]) & (y <= ends[3])
    return fine


def _path(solved: _Flights, row: int, moments: Array, physics: SegmentationPhysics, sightings: int) -> Path:
    """The path of one solution at moments (n,) s; misfits widen its sigmas."""
    since = moments - solved.times[row]
    unknown, covariance = solved.unknown[row], solved.covariance[row]
    later = (since > 0.0) & solved.bounces
    start = np.where(later[:, None], unknown[6:], unknown[3:6])
    drag = physics.drag * np.minimum(np.linalg.norm(start, axis=1), 2.0 * SPEED)
    span = _stretched(since[None], drag[None])[0]
    positions = unknown[:3] + start * span[:, None]
    positions[:, Z] -= 0.5 * physics.gravity * since**2
    velocities = start / (1.0 + np.maximum(drag * since, STRETCH_LIMIT))[:, None]
    velocities[:, Z] -= physics.gravity * since
    slope = np.zeros((len(since), 3, 9))
    for axis in range(3):
        slope[:, axis, axis] = 1.0
        slope[:, axis, 3 + axis] = np.where(later, 0.0, span)
        slope[:, axis, 6 + axis] = np.where(later, span, 0.0)
    variance = np.einsum("nij,jk,nik->ni", slope, covariance, slope)
    scale = max(float(solved.misfit[row]) / max(2 * sightings - 8, 1), 1.0)
    return Path(positions, velocities, np.sqrt(scale * variance))
