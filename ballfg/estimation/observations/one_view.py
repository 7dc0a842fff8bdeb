"""Finds the path of a ball that was seen from one point: bounces and gravity give the depth that rays lack.

At a guessed time the ball bounces where the ray then meets a surface, with flights before and after it. Each sighting
gives two equations that are linear in the place of the first bounce and in the velocity of each flight. The time of a
bounce is scanned, and the smallest misfit counts; a further bounce is taken if it fits much better. Without a bounce,
gravity gives the scale: a flight is linear in its position and velocity. Drag stretches a flight's time to
ln(1 + k v s) / (k v), with the speed v of the last solution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
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
PLANE_SIGMA: Final = 1e-3
"""m, of the height at which a ball bounces."""
LAWS: Final = 5e-3
"""m, standard deviation of the ball's place about a path of these laws, which leave out spin."""
PRICE: Final = 10.0
"""Twice the log likelihood that a bounce must gain over a path without it."""
BETTER: Final = 1.15
"""Factor by which a further bounce must lower the misfit: spin bends flights too, but less."""
POOR: Final = 20.0
"""Misfit for each sighting from which the first bounces may be wrong, and are scanned again beside a further one."""
MOST_BOUNCES: Final = 4
RIVAL: Final = 10.0
"""Twice the log likelihood by which a bounce between two other samples may fit worse and is tried all the same."""
MOST_RIVALS: Final = 2
ASIDE: Final = 0.1
"""m beside the table where a bounce may seem to be."""
STRETCH_LIMIT: Final = -0.8
"""Least k v s: before that the ball would have come from infinity."""


@dataclass(frozen=True)
class OneView:
    """The path of a ball at the moments of its track, and its bounces at some times, s, on a surface at a height, m.

    Its misfit is twice the sum of the losses of sightings and priors.
    """

    path: Path
    bounces: tuple[float, ...]
    height: float
    misfit: float

    def contacts(self, times: Array) -> tuple[Contact, ...]:
        """The bounces between two of the samples at times (n,) s."""
        places = np.searchsorted(times, self.bounces, side="right") - 1
        intervals = np.clip(places, 0, max(len(times) - 2, 0)).tolist()
        return tuple(Contact(i, time, self.height) for i, time in zip(intervals, self.bounces, strict=True))


@dataclass(frozen=True)
class _Scene:
    """The rays, the ball, and the surfaces with the height, m, at which the ball bounces on one of them."""

    rays: Rays
    physics: SegmentationPhysics
    surfaces: Surfaces
    height: float

    @property
    def plane(self) -> float:
        """m, of the ball's centre at a bounce."""
        return self.height + self.physics.radius + self.physics.surface_offset


@dataclass(frozen=True)
class _Paths:
    """Solutions for k guesses of b bounces: `vectors` are the first bounce's place, m, and each flight's velocity, m/s.

    A flight's velocity is that after its bounce, of the first flight that before the first bounce; without bounces
    `times` has an anchor in the middle.
    """

    times: Array  # (k, max(b, 1)) s
    bounces: int
    misfit: Array  # (k,)
    vectors: Array  # (k, b + 2, 3)
    drag: Array  # (k, b + 1) 1/s, k |v| of each flight
    covariance: Array  # (k, 3 (b + 2), 3 (b + 2))


def one_view(rays: Rays, moments: Array, physics: SegmentationPhysics, surfaces: Surfaces) -> list[OneView]:
    """The likely paths, best first; the others have a bounce in another interval, or one bounce less.

    Args: rays: of all sightings.  moments: (n,) s, of the track's samples.  physics: of the ball.  surfaces: to meet.
    """
    middle = np.array([[float(np.median(rays.times))]])
    table = _Scene(rays, physics, surfaces, surfaces.table_height)
    flight = _solved(table, middle, 0)
    for height in surfaces.heights():  # the floor only gets what cannot be on the table: farther and faster look alike
        scene = replace(table, height=height)
        found = _bounced(scene, moments)
        if found and found[-1][1].min() + PRICE < flight.misfit[0]:
            tried, misfit = found[-1]
            rows = _rivals(misfit, np.searchsorted(moments, tried.times, side="right"))
            fewer = [_path(scene, few, int(np.argmin(fit)), moments) for few, fit in found[-2:-1]]
            return [*(_path(scene, tried, row, moments) for row in rows), *fewer]
    return [_path(table, flight, 0, moments)]


def _bounced(scene: _Scene, moments: Array) -> list[tuple[_Paths, Array]]:
    """Paths with one bounce at all guessed times and misfits (k,); then those with more, while they fit better."""
    step = STEPS * scene.rays.period
    if not step > 0.0 or len(moments) < 2:
        return []
    guesses = np.arange(moments[0] + step, moments[-1] - 0.5 * step, step)
    further = guesses[(guesses > moments[1]) & (guesses < moments[-2])]  # a flight of one sample explains anything
    found, least, poor = list[tuple[_Paths, Array]](), np.inf, POOR * len(scene.rays.times)
    more = _one_more(scene, np.zeros(0), guesses)
    while more is not None:
        for number in range(more[0].bounces if least > poor else 0):  # the others again, beside the new one
            again = _one_more(scene, np.delete(_best(*more), number), guesses)
            more = again if again is not None and again[1].min() < more[1].min() else more
        if BETTER * more[1].min() + PRICE < least:
            found, least = [*found, more], float(more[1].min())
        elif found:
            break
        more = _one_more(scene, _best(*more), further) if more[0].bounces < MOST_BOUNCES else None
    return found


def _best(tried: _Paths, misfit: Array) -> Array:
    """(b,) s, times of the bounces of the best path; if all are impossible, of the best of these."""
    return np.asarray(tried.times[int(np.argmin(misfit if np.isfinite(misfit).any() else tried.misfit))])


def _one_more(scene: _Scene, known: Array, guesses: Array) -> tuple[_Paths, Array] | None:
    """The paths with known bounces and another one at each guess, and misfits (k,), infinite where impossible."""
    free = guesses[(np.abs(guesses[:, None] - known) > scene.rays.period).all(axis=1)]
    if not len(free):
        return None
    times = np.sort(np.concatenate((np.tile(known, (len(free), 1)), free[:, None]), axis=1), axis=1)
    tried = _solved(scene, times, times.shape[1])
    return tried, np.where(_possible(scene, tried), tried.misfit, np.inf)


def _rivals(misfit: Array, intervals: Index) -> list[int]:
    """The best guess, and those with other intervals (k, b) that are nearly as good, best first."""
    order = [int(row) for row in np.argsort(misfit, kind="stable") if misfit[row] <= misfit.min() + RIVAL]
    first = {tuple(intervals[row].tolist()): row for row in reversed(order)}
    return sorted(first.values(), key=order.index)[: 1 + MOST_RIVALS]


def _solved(scene: _Scene, times: Array, bounces: int) -> _Paths:
    """The paths with bounces at guessed times (k, b) s, or of one flight about an anchor (k, 1) s."""
    rays, physics = scene.rays, scene.physics
    k, m, size = len(times), len(rays.times), 3 * (bounces + 2)
    drag, depth, weight = np.zeros((k, bounces + 1)), np.ones((k, m)), np.ones((k, m))
    precision = LAWS**2 * np.linalg.det(rays.root)  # (m,) of a sighting, at 1 m, beside that of the laws
    for _ in range(ROUNDS):
        prior, target = _priors(scene, times, bounces, drag)
        share, drop = _shares(rays.times[None], times, bounces, drag, physics.gravity)
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
        vectors = unknown.reshape(k, bounces + 2, 3)
        drag = physics.drag * np.minimum(np.linalg.norm(vectors[:, 1:], axis=-1), 2.0 * SPEED)
        point = share @ vectors
        point[..., Z] -= drop
        depth = np.maximum((rays.depth_row[:, :3] * point).sum(axis=-1) + rays.depth_row[:, 3], NEAREST)
    loss = ROBUST**2 * np.log1p(square / ROBUST**2).sum(axis=1)
    misfit = loss + (((prior @ unknown)[..., 0] - target) ** 2).sum(axis=1)
    return _Paths(times, bounces, misfit, vectors, drag, np.asarray(np.linalg.inv(information), dtype=np.float64))


def _shares(moments: Array, times: Array, bounces: int, drag: Array, gravity: float) -> tuple[Array, Array]:
    """Positions at moments (1 or k, n) s as sums: shares (k, n, b + 2) of the vectors, drops (k, n) m by gravity."""
    later = (moments[..., None] > times[:, None, :]).sum(axis=2) * (bounces > 0)
    share = np.zeros((*later.shape, bounces + 2))
    drop = np.zeros(share.shape[:2])
    share[..., 0] = 1.0
    for flight in range(bounces + 1):
        begin = times[:, max(flight - 1, 0), None]
        since = moments - begin
        if 0 < flight < bounces:  # a whole flight for all later moments
            since = np.minimum(since, times[:, flight, None] - begin)
        flown = (later >= flight) if flight else (later == 0)
        share[..., 1 + flight] = np.where(flown, _stretched(since, drag[:, flight, None]), 0.0)
        slower = np.maximum(drag[:, flight, None] * since, STRETCH_LIMIT)
        drop += np.where(flown, 0.5 * gravity * since**2 / (1.0 + slower / 3.0), 0.0)
    return share, drop


def _stretched(since: Array, drag: Array) -> Array:
    """(k, n) s: the time in which a ball without drag covers the same way, for drag k v (k, 1) 1/s."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(drag > 0.0, np.log1p(np.maximum(drag * since, STRETCH_LIMIT)) / drag, since)


def place_prior(surfaces: Surfaces) -> tuple[Array, float]:
    """Mean (3,) m and standard deviation, m, of the place of a ball in play: about the table, if its ends are known."""
    if surfaces.extent is None or not np.isfinite(surfaces.extent).all():
        return np.array([0.0, 0.0, surfaces.table_height]), SPREAD
    low, high = np.array(surfaces.extent).reshape(2, 2).T
    return np.append((low + high) / 2, surfaces.table_height), PLAY * float(np.linalg.norm(high - low)) / 2


def _priors(scene: _Scene, times: Array, bounces: int, drag: Array) -> tuple[Array, Array]:
    """Whitened rows (k, r, 3 (b + 2)) and their targets (k, r): wide priors, and the plane and laws of each bounce."""
    (centre, spread), g, k = place_prior(scene.surfaces), scene.physics.gravity, len(times)
    size = 3 * (bounces + 2)
    rows, targets = np.zeros((k, size + 4 * bounces, size)), np.zeros((k, size + 4 * bounces))
    rows[:, range(size), range(size)] = np.append(np.full(3, 1.0 / spread), np.full(size - 3, 1.0 / SPEED))
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
        share, drop = _shares(times[:, [bounce]], times, bounces, drag, g)
        rows[:, law + 3, Z::3] = share[:, 0] / PLANE_SIGMA
        targets[:, law + 3] = (scene.plane + drop[:, 0]) / PLANE_SIGMA
    return rows, targets


def _possible(scene: _Scene, tried: _Paths) -> NDArray[np.bool_]:
    """(k,) True if all bounces rise, the first from above, and lie within the ends of the table, if it is the table."""
    fine = (tried.vectors[:, 1, Z] < 0.0) & (tried.vectors[:, 2:, Z] > 0.0).all(axis=1)
    ends = scene.surfaces.extent
    if scene.height != scene.surfaces.table_height or ends is None:
        return np.asarray(fine)
    for bounce in range(tried.bounces):
        share, _ = _shares(tried.times[:, [bounce]], tried.times, tried.bounces, tried.drag, scene.physics.gravity)
        x, y, _ = (share @ tried.vectors)[:, 0].T
        fine &= (x >= ends[0] - ASIDE) & (x <= ends[1] + ASIDE) & (y >= ends[2] - ASIDE) & (y <= ends[3] + ASIDE)
    return np.asarray(fine)


def _path(scene: _Scene, tried: _Paths, row: int, moments: Array) -> OneView:
    """One solution at moments (n,) s; misfits widen its sigmas."""
    times, drag, g = tried.times[[row]], tried.drag[[row]], scene.physics.gravity
    (share,), (drop,) = _shares(moments[None], times, tried.bounces, drag, g)
    positions = share @ tried.vectors[row]
    positions[:, Z] -= drop
    joint = tried.covariance[row].reshape(share.shape[1], 3, share.shape[1], 3)
    variance = np.einsum("ni,iaja,nj->na", share, joint, share)
    misfit = float(tried.misfit[row])
    spare = max(2 * len(moments) - 3 * share.shape[1], 1)
    bounces = tuple(times[0].tolist()) if tried.bounces else ()
    return OneView(
        Path(positions, _velocities(tried, row, moments, g), np.sqrt(max(misfit / spare, 1.0) * variance)),
        bounces,
        scene.height,
        misfit,
    )


def _velocities(tried: _Paths, row: int, moments: Array, gravity: float) -> Array:
    """(n, 3) m/s at moments (n,) s."""
    times = tried.times[row]
    flight = (moments[:, None] > times).sum(axis=1) if tried.bounces else np.zeros(len(moments), dtype=np.int64)
    since = moments - times[np.maximum(flight - 1, 0)]
    slower = np.maximum(tried.drag[row, flight] * since, STRETCH_LIMIT)
    velocities = tried.vectors[row, 1 + flight] / (1.0 + slower)[:, None]
    velocities[:, Z] -= gravity * since / (1.0 + slower / 2.0)
    return np.asarray(velocities)
