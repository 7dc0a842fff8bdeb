"""Solves for the path of a ball about bounces at guessed times, from rays of one point, for many guesses at once.

Each sighting gives two equations that are linear in the place of the first bounce and in the velocity of each flight.
Drag stretches a flight's time s to ln(1 + k v s) / (k v), with the speed v of the last solution, and shortens the fall
g s^2 / 2 by 1 + k v s / 3. Spin, where a scene has it, accelerates each flight evenly, the more the faster it is.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index, plain
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.bounced_code import NUMBERS, RAY, STRETCH_LIMIT, all_flown, shares_at
from ballfg.estimation.observations.ray_path import SPREAD, Rays
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.state import Z

PLAY: Final = 1.0
"""Half diagonals of a table, prior standard deviation along each axis of the ball's place about its centre."""
LIFT: Final = (1.0 / 6.0, 0.5, 0.5)
"""1/s, prior standard deviation of the acceleration by spin for each m/s of speed: 170 rad/s; it stands across the
flight, which goes along x."""
ASIDE: Final = 0.1  # m beside the table where a bounce may seem to be


@dataclass(frozen=True)
class Scene:
    """The rays, the ball, and the surfaces with the height, m, at which the ball bounces on one of them."""

    rays: Rays
    physics: SegmentationPhysics
    surfaces: Surfaces
    height: float
    lift: tuple[float, float, float] | None = None
    """1/s, prior standard deviations of a flight's constant acceleration by spin, by its speed; None: no spin."""

    @property
    def plane(self) -> float:
        """m, of the ball's centre at a bounce, at the origin."""
        return self.height + self.physics.radius + self.physics.surface_offset

    @cached_property
    def numbers(self) -> Any:
        """The ball and its place for machine code, of `NUMBERS`."""
        ball, place = self.physics, place_prior(self.surfaces)
        slope = ball.slope_x, ball.slope_y
        own = (ball.gravity, ball.drag, ball.restitution, self.plane, slope, *place, self.lift or (0.0, 0.0, 0.0))
        return np.array([own], dtype=NUMBERS)[0]

    @cached_property
    def sightings(self) -> NDArray[np.void]:
        """(m,) the rays for machine code, of `RAY`."""
        found, rays = np.zeros(len(self.rays.times), dtype=RAY), self.rays
        for name, values in zip(
            RAY.names or (), (rays.times, rays.matrix, rays.target, rays.root, rays.depth_row), strict=True
        ):
            found[name] = values
        return found


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
    narrowed: Array  # (k,), logarithm of the share of its prior volume that a path has left: Occam's factor
    vectors: Array  # (k, c, 3), c = b + 2, or 2 b + 3 with lift
    drag: Array  # (k, b + 1) 1/s, k |v| of each flight
    covariance: Array  # (k, 3 c, 3 c)


def solved(scene: Scene, times: Array, bounces: int, rows: Index | None = None, *, wide: bool = True) -> Paths:
    """The paths with bounces at guessed times (k, b) s, or of one flight about an anchor (k, 1) s.

    Args:
        rows: numbers (1 or k, m) of the scene's rays through which they go; None: all.
        wide: False leaves out covariances and `narrowed`, for guesses of which one is solved again.
    """
    k, count = len(times), bounces + 2 + (0 if scene.lift is None else bounces + 1)
    rows = np.arange(len(scene.sightings))[None] if rows is None else rows
    numbers, vectors, drag = np.empty((k, 2)), np.empty((k, count, 3)), np.empty((k, bounces + 1))
    covariance, times = np.empty((k * wide, 3 * count, 3 * count)), plain(times)
    all_flown(scene.sightings, rows, scene.numbers, times, bounces, numbers, vectors, drag, covariance)
    return Paths(times, bounces, numbers[:, 0], numbers[:, 1], vectors, drag, covariance)


def shares_of(
    moments: Array, times: Array, bounces: int, drag: Array, gravity: float, *, lift: bool = False
) -> tuple[Array, Array]:
    """Positions at moments (1 or k, n) s as sums: shares (k, n, c) of the vectors, drops (k, n) m by gravity."""
    k, n = len(times), moments.shape[1]
    share, drop = np.empty((k, n, bounces + 2 + lift * (bounces + 1))), np.empty((k, n))
    shares_at(plain(moments), plain(times), bounces, plain(drag), gravity, share, drop)
    return share, drop


def places_of(scene: Scene, tried: Paths, row: int, moments: Array) -> tuple[Array, Array]:
    """Positions (n, 3) m of one of the paths at moments (n,) s, and their covariances (n, 3, 3) m^2."""
    own, g = (tried.times[[row]], tried.bounces, tried.drag[[row]]), scene.physics.gravity
    (share,), (drop,) = shares_of(moments[None], *own, g, lift=scene.lift is not None)
    positions = share @ tried.vectors[row]
    positions[:, Z] -= drop
    joint = tried.covariance[row].reshape(share.shape[1], 3, share.shape[1], 3)
    return positions, np.asarray(np.einsum("na,aibj,nb->nij", share, joint, share))


@lru_cache(maxsize=8)
def place_prior(surfaces: Surfaces) -> tuple[Array, float]:
    """Mean (3,) m and standard deviation, m, of the place of a ball in play: about the table, if its ends are known."""
    if surfaces.extent is None or not np.isfinite(surfaces.extent).all():
        return np.array([0.0, 0.0, surfaces.table_height]), SPREAD
    low, high = np.array(surfaces.extent).reshape(2, 2).T
    return np.append((low + high) / 2, surfaces.table_height), PLAY * float(np.linalg.norm(high - low)) / 2


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


def velocities_of(tried: Paths, row: int, moments: Array, gravity: float) -> Array:
    """(n, 3) m/s at moments (n,) s."""
    times = tried.times[row]
    flight = (moments[:, None] > times).sum(axis=1) if tried.bounces else np.zeros(len(moments), dtype=np.int64)
    since = moments - times[np.maximum(flight - 1, 0)]
    slower = np.maximum(tried.drag[row, flight] * since, STRETCH_LIMIT)
    velocities = tried.vectors[row, 1 + flight] / (1.0 + slower)[:, None]
    velocities[:, Z] -= gravity * since / (1.0 + slower / 2.0)
    return np.asarray(velocities)
