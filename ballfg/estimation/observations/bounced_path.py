"""Solves for the path of a ball about bounces at guessed times, from rays of one point, for many guesses at once.

Each sighting gives two equations that are linear in the place of the first bounce and in the velocity of each flight.
Drag stretches a flight's time s to ln(1 + k v s) / (k v), with the speed v of the last solution, and shortens the fall
g s^2 / 2 by 1 + k v s / 3. Spin, where a scene has it, accelerates each flight evenly.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.ray_path import NEAREST, ROBUST, ROUNDS, SPREAD, Rays
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.state import Z

SPEED: Final = 15.0  # m/s, prior standard deviation of each component of a velocity
PLAY: Final = 1.0
"""Half diagonals of a table, prior standard deviation along each axis of the ball's place about its centre."""
KEPT: Final = 0.8  # Share of the horizontal velocity that a bounce leaves; friction takes or adds some
FRICTION_SIGMA: Final = 1.0  # m/s, standard deviation about it: the spin is unknown
RESTITUTION_SIGMA: Final = 0.15  # m/s, of the vertical velocity after a bounce
PLANE_SIGMA: Final = 1e-3  # m, of the height at which a ball bounces
LAWS: Final = 5e-3  # m, standard deviation of the ball's place about a path of these laws, which leave out spin
LIFT: Final = (2.0, 6.0, 6.0)
"""m/s^2, prior standard deviation of the acceleration by spin: 12 m/s and 170 rad/s; it stands across the flight, which
goes along x."""
ASIDE: Final = 0.1  # m beside the table where a bounce may seem to be
STRETCH_LIMIT: Final = -0.8  # Least k v s: before that the ball would have come from infinity


@dataclass(frozen=True)
class Scene:
    """The rays, the ball, and the surfaces with the height, m, at which the ball bounces on one of them."""

    rays: Rays
    physics: SegmentationPhysics
    surfaces: Surfaces
    height: float
    lift: tuple[float, float, float] | None = None
    """m/s^2, prior standard deviations of a flight's constant acceleration by spin; None: no spin."""

    @property
    def plane(self) -> float:
        """m, of the ball's centre at a bounce."""
        return self.height + self.physics.radius + self.physics.surface_offset


@dataclass(frozen=True)
class Paths:
    """Solutions for k guesses of b bounces: `vectors` are the first bounce's place, m, and each flight's velocity, m/s.

    Where a scene has lift, they end with each flight's acceleration by it, m/s^2.

    A flight's velocity is that after its bounce, of the first flight that before the first bounce; without bounces
    `times` has an anchor in the middle.
    """

    times: Array  # (k, max(b, 1)) s
    bounces: int
    misfit: Array  # (k,)
    vectors: Array  # (k, c, 3), c = b + 2, or 2 b + 3 with lift
    drag: Array  # (k, b + 1) 1/s, k |v| of each flight
    covariance: Array  # (k, 3 c, 3 c)


def solved(scene: Scene, times: Array, bounces: int) -> Paths:
    """The paths with bounces at guessed times (k, b) s, or of one flight about an anchor (k, 1) s.

    Args: scene: with rays (m,) of all guesses, or (k, m) of each.
    """
    rays, physics = scene.rays, scene.physics
    k, m, size = len(times), rays.times.shape[-1], 3 * columns_of(scene, bounces)
    drag, depth, weight = np.zeros((k, bounces + 1)), np.ones((k, m)), np.ones((k, m))
    precision = LAWS**2 * np.linalg.det(rays.root)  # of a sighting, at 1 m, beside that of the laws
    for _ in range(ROUNDS):
        prior, target = _priors(scene, times, bounces, drag)
        share, drop = shares_of(
            np.atleast_2d(rays.times), times, bounces, drag, physics.gravity, lift=scene.lift is not None
        )
        root = rays.root / np.sqrt(depth**2 + precision)[..., None, None]
        seen = (root @ rays.matrix)[:, :, :, None, :] * share[:, :, None, :, None]
        seen = seen.reshape(k, 2 * m, size)
        wanted = (root @ (rays.target + rays.matrix[..., Z] * drop[..., None])[..., None]).reshape(k, 2 * m)
        pulled = seen.swapaxes(1, 2) * np.repeat(weight, 2, axis=1)[:, None]
        turned = prior.swapaxes(1, 2)
        information = pulled @ seen + turned @ prior
        side = pulled @ wanted[..., None] + turned @ target[..., None]
        unknown: Array = np.asarray(np.linalg.solve(information, side), dtype=np.float64)
        square = (((seen @ unknown)[..., 0] - wanted).reshape(k, m, 2) ** 2).sum(axis=-1)
        weight = 1.0 / (1.0 + square / ROBUST**2)
        vectors = unknown.reshape(k, -1, 3)
        drag = physics.drag * np.minimum(np.linalg.norm(vectors[:, 1 : bounces + 2], axis=-1), 2.0 * SPEED)
        point = share @ vectors
        point[..., Z] -= drop
        depth = np.maximum((rays.depth_row[..., :3] * point).sum(axis=-1) + rays.depth_row[..., 3], NEAREST)
    loss = ROBUST**2 * np.log1p(square / ROBUST**2).sum(axis=1)
    misfit = loss + (((prior @ unknown)[..., 0] - target) ** 2).sum(axis=1)
    return Paths(times, bounces, misfit, vectors, drag, np.asarray(np.linalg.inv(information), dtype=np.float64))


def columns_of(scene: Scene, bounces: int) -> int:
    """Number of vectors of a path."""
    return bounces + 2 + (0 if scene.lift is None else bounces + 1)


def shares_of(
    moments: Array, times: Array, bounces: int, drag: Array, gravity: float, *, lift: bool = False
) -> tuple[Array, Array]:
    """Positions at moments (1 or k, n) s as sums: shares (k, n, c) of the vectors, drops (k, n) m by gravity."""
    later = (moments[..., None] > times[:, None, :]).sum(axis=2)[..., None] * (bounces > 0)
    flight = np.arange(bounces + 1)
    begin = times[:, None, np.maximum(flight - 1, 0)]
    since = moments[..., None] - begin
    for whole in range(1, bounces):  # a whole flight for all later moments
        since[..., whole] = np.minimum(since[..., whole], times[:, whole, None] - times[:, whole - 1, None])
    flown = np.where(flight > 0, later >= flight, later == 0)
    square, slower = np.where(flown, 0.5 * since**2, 0.0), np.maximum(drag[:, None] * since, STRETCH_LIMIT)
    # the time in which a ball without drag covers the same way
    stretched = np.where(drag[:, None] > 0.0, np.log1p(slower) / np.where(drag > 0.0, drag, 1.0)[:, None], since)
    parts = (np.ones_like(since[..., :1]), np.where(flown, stretched, 0.0), *((square,) if lift else ()))
    return np.concatenate(parts, axis=2), gravity * (square / (1.0 + slower / 3.0)).sum(axis=2)


@lru_cache(maxsize=8)
def place_prior(surfaces: Surfaces) -> tuple[Array, float]:
    """Mean (3,) m and standard deviation, m, of the place of a ball in play: about the table, if its ends are known."""
    if surfaces.extent is None or not np.isfinite(surfaces.extent).all():
        return np.array([0.0, 0.0, surfaces.table_height]), SPREAD
    low, high = np.array(surfaces.extent).reshape(2, 2).T
    return np.append((low + high) / 2, surfaces.table_height), PLAY * float(np.linalg.norm(high - low)) / 2


def _priors(scene: Scene, times: Array, bounces: int, drag: Array) -> tuple[Array, Array]:
    """Whitened rows (k, r, 3 (b + 2)) and their targets (k, r): wide priors, and the plane and laws of each bounce."""
    (centre, spread), g, k = place_prior(scene.surfaces), scene.physics.gravity, len(times)
    size, straight = 3 * columns_of(scene, bounces), 3 * (bounces + 2)
    rows, targets = np.zeros((k, size + 4 * bounces, size)), np.zeros((k, size + 4 * bounces))
    sigmas = np.concatenate((np.repeat((spread, SPEED), (3, straight - 3)), (scene.lift or ()) * (bounces + 1)))
    rows[:, range(size), range(size)] = 1.0 / sigmas
    targets[:, :3] = centre / spread
    for bounce in range(bounces):
        law, before, after = size + 4 * bounce, 3 + 3 * bounce, 6 + 3 * bounce
        flown = times[:, bounce] - times[:, max(bounce - 1, 0)]
        slowed = 1.0 / (1.0 + drag[:, bounce] * flown)
        for axis in range(2):
            rows[:, law + axis, after + axis] = 1.0 / FRICTION_SIGMA
            rows[:, law + axis, before + axis] = -KEPT * slowed / FRICTION_SIGMA
        rows[:, law + 2, after + Z] = 1.0 / RESTITUTION_SIGMA
        rows[:, law + 2, before + Z] = scene.physics.restitution * slowed / RESTITUTION_SIGMA
        fallen = g * flown / (1.0 + drag[:, bounce] * flown / 2.0)
        targets[:, law + 2] = scene.physics.restitution * fallen / RESTITUTION_SIGMA
        if bounce and scene.lift is not None:
            turned = straight + 3 * bounce
            rows[:, law, turned], rows[:, law + 1, turned + 1] = (-KEPT * flown / FRICTION_SIGMA,) * 2
            rows[:, law + 2, turned + Z] = scene.physics.restitution * flown / RESTITUTION_SIGMA
    if bounces:
        share, drop = shares_of(times, times, bounces, drag, g, lift=scene.lift is not None)
        rows[:, size + 3 :: 4, Z::3] = share / PLANE_SIGMA
        targets[:, size + 3 :: 4] = (scene.plane + drop) / PLANE_SIGMA
    return rows, targets


def possible(scene: Scene, tried: Paths) -> NDArray[np.bool_]:
    """(k,) True if all bounces rise, the first from above, and lie within the ends of the table, if it is the table."""
    fine = (tried.vectors[:, 1, Z] < 0.0) & (tried.vectors[:, 2 : tried.bounces + 2, Z] > 0.0).all(axis=1)
    ends = scene.surfaces.extent
    if scene.height != scene.surfaces.table_height or ends is None:
        return np.asarray(fine)
    for bounce in range(tried.bounces):
        at = tried.times[:, [bounce]]
        lift = scene.lift is not None
        share, _ = shares_of(at, tried.times, tried.bounces, tried.drag, scene.physics.gravity, lift=lift)
        x, y, _ = (share @ tried.vectors)[:, 0].T
        fine &= (x >= ends[0] - ASIDE) & (x <= ends[1] + ASIDE) & (y >= ends[2] - ASIDE) & (y <= ends[3] + ASIDE)
    return np.asarray(fine)


def narrowed(scene: Scene, tried: Paths) -> Array:
    """(k,) logarithm of the share of its prior volume that a path has left: the factor of Occam in its evidence."""
    rows, _ = _priors(scene, tried.times, tried.bounces, tried.drag)
    before = np.linalg.slogdet(rows.swapaxes(1, 2) @ rows)[1]
    return np.asarray(0.5 * (before + np.linalg.slogdet(tried.covariance)[1]))


def velocities_of(tried: Paths, row: int, moments: Array, gravity: float) -> Array:
    """(n, 3) m/s at moments (n,) s."""
    times = tried.times[row]
    flight = (moments[:, None] > times).sum(axis=1) if tried.bounces else np.zeros(len(moments), dtype=np.int64)
    since = moments - times[np.maximum(flight - 1, 0)]
    slower = np.maximum(tried.drag[row, flight] * since, STRETCH_LIMIT)
    velocities = tried.vectors[row, 1 + flight] / (1.0 + slower)[:, None]
    velocities[:, Z] -= gravity * since / (1.0 + slower / 2.0)
    return np.asarray(velocities)
