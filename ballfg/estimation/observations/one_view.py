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
PLAY: Final = 1.0
"""Half diagonals of a table, prior standard deviation along each axis of the ball's place about its centre."""
KEPT: Final = 0.8
"""Share of the horizontal velocity that a bounce leaves; friction takes or adds some."""
FRICTION_SIGMA: Final = 1.0
"""m/s, standard deviation about it: the spin is unknown."""
RESTITUTION_SIGMA: Final = 0.15
"""m/s, of the vertical velocity after a bounce."""
PRICE: Final = 10.0
"""Twice the log likelihood that a bounce must gain over a flight without one."""
RIVAL: Final = 10.0
"""Twice the log likelihood by which a bounce between two other samples may fit worse and is tried all the same."""
MOST_RIVALS: Final = 2
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
        height: m, declared height of the surface there; None without a bounce.
        misfit: twice the sum of the losses of sightings and priors.
    """

    path: Path
    bounce: float | None
    height: float | None
    misfit: float

    def contact(self, times: Array) -> Contact | None:
        """The bounce between two of the samples at times (n,) s; None without one."""
        if self.bounce is None or self.height is None:
            return None
        interval = int(np.clip(np.searchsorted(times, self.bounce, side="right") - 1, 0, len(times) - 2))
        return Contact(interval, self.bounce, self.height)


@dataclass(frozen=True)
class _Flights:
    """Solutions about k guessed times, s: misfits (k,), unknowns (k, 9), covariances (k, 9, 9)."""

    times: Array
    misfit: Array
    unknown: Array
    covariance: Array


def one_view(rays: Rays, moments: Array, physics: SegmentationPhysics, surfaces: Surfaces) -> list[OneView]:
    """The likely paths with one bounce or none, best first; those beside the best bounce in other intervals.

    Args: rays: of all sightings.  moments: (n,) s, of the track's samples.  physics: of the ball.  surfaces: to meet.
    """
    flight = _solved(rays, np.array([float(np.median(rays.times))]), None, physics, surfaces)
    step = STEPS * rays.period
    guesses = np.arange(rays.times[0] + step, rays.times[-1] - 0.5 * step, step) if step > 0.0 else np.zeros(0)
    for place, height in enumerate(surfaces.heights() if len(guesses) else ()):
        plane = height + physics.radius + physics.surface_offset
        tried = _solved(rays, guesses, plane, physics, surfaces)
        misfit = np.where(_possible(tried, surfaces if place == 0 else None), tried.misfit, np.inf)
        if misfit.min() + PRICE < flight.misfit[0]:  # the next surface only gets what cannot be on this one
            rows = _rivals(misfit, np.searchsorted(moments, guesses, side="right"))
            return [_path(tried, row, height, moments, physics) for row in rows]
    return [_path(flight, 0, None, moments, physics)]


def _rivals(misfit: Array, intervals: NDArray[np.int64]) -> list[int]:
    """The best guess, and those of other intervals that are nearly as good, best first, `MOST_RIVALS` at most."""
    order = [int(row) for row in np.argsort(misfit, kind="stable") if misfit[row] <= misfit.min() + RIVAL]
    first = {int(intervals[row]): row for row in reversed(order)}
    return sorted(first.values(), key=order.index)[: 1 + MOST_RIVALS]


def _solved(
    rays: Rays, guesses: Array, plane: float | None, physics: SegmentationPhysics, surfaces: Surfaces
) -> _Flights:
    """The flights through a point at guessed times (k,) s, which lies at height `plane` m; None: anywhere, no bounce.

    The unknowns are the point and the velocities before and after; without a bounce the last one counts nowhere.
    """
    prior, target = _priors(plane, physics, surfaces)
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
    return _Flights(guesses, misfit, unknown, np.linalg.inv(information))


def place_prior(surfaces: Surfaces) -> tuple[Array, float]:
    """Mean (3,) m and standard deviation, m, of the place of a ball in play: about the table, if its ends are known."""
    if surfaces.extent is None or not np.isfinite(surfaces.extent).all():
        return np.array([0.0, 0.0, surfaces.table_height]), SPREAD
    low, high = np.array(surfaces.extent).reshape(2, 2).T
    return np.append((low + high) / 2, surfaces.table_height), PLAY * float(np.linalg.norm(high - low)) / 2


def _priors(plane: float | None, physics: SegmentationPhysics, surfaces: Surfaces) -> tuple[Array, Array]:
    """Whitened rows (r, 9) and their targets (r,): wide priors; with a bounce, its plane and its laws."""
    centre, spread = place_prior(surfaces)
    wide, target = np.diag([1.0 / spread] * 3 + [1.0 / SPEED] * 6), np.append(centre / spread, np.zeros(6))
    if plane is None:
        return wide, target
    laws = np.zeros((4, 9))
    before, after = np.eye(3, 9, 3), np.eye(3, 9, 6)
    laws[0, Z] = 1.0 / PLANE_SIGMA
    laws[1:3] = (after[:2] - KEPT * before[:2]) / FRICTION_SIGMA
    laws[3] = (after[2] + physics.restitution * before[2]) / RESTITUTION_SIGMA
    return np.concatenate((wide, laws)), np.append(target, (plane / PLANE_SIGMA, 0.0, 0.0, 0.0))


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


def _path(solved: _Flights, row: int, height: float | None, moments: Array, physics: SegmentationPhysics) -> OneView:
    """One solution at moments (n,) s, with a bounce on a surface at `height` m; misfits widen its sigmas."""
    since = moments - solved.times[row]
    unknown, covariance = solved.unknown[row], solved.covariance[row]
    later = (since > 0.0) & (height is not None)
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
    misfit = float(solved.misfit[row])
    sigmas = np.sqrt(max(misfit / max(2 * len(moments) - 8, 1), 1.0) * variance)
    bounce = None if height is None else float(solved.times[row])
    return OneView(Path(positions, velocities, sigmas), bounce, height, misfit)
