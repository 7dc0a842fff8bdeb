"""Solves for paths about bounces in machine code: the sums, laws and equations that `bounced_path` explains."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numba import from_dtype, types

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, FLAG, INDEX, NOTHING, ONE, REAL, THREE, TWO
from ballfg.estimation.observations.ray_path import NEAREST, ROBUST, ROUNDS

SPEED: Final = 15.0  # m/s, prior standard deviation of each component of a velocity
SLOWEST: Final = 0.1  # m/s, the least speed by which lift is counted
KEPT: Final = 0.8  # Share of the horizontal velocity that a bounce leaves; friction takes or adds some
FRICTION_SIGMA: Final = 1.0  # m/s, standard deviation about it: the spin is unknown
RESTITUTION_SIGMA: Final = 0.15  # m/s, of the vertical velocity after a bounce
PLANE_SIGMA: Final = 1e-3  # m, of the height at which a ball bounces
LAWS: Final = 5e-3  # m, standard deviation of the ball's place about a path of these laws, which leave out spin
STRETCH_LIMIT: Final = -0.8  # Least k v s: before that the ball would have come from infinity
RULES: Final = 4
"""Equations that a bounce adds: friction along x and y, restitution, and the plane on which it happens."""

RAY: Final = np.dtype(
    [
        ("time", np.float64),
        ("matrix", np.float64, (2, 3)),
        ("target", np.float64, (2,)),
        ("root", np.float64, (2, 2)),
        ("depth_row", np.float64, (4,)),
    ]
)
"""A sighting, as in `Rays`."""
NUMBERS: Final = np.dtype(
    [
        ("gravity", np.float64),
        ("drag", np.float64),
        ("restitution", np.float64),
        ("plane", np.float64),
        ("slope", np.float64, (2,)),
        ("centre", np.float64, (3,)),
        ("spread", np.float64),
        ("lift", np.float64, (3,)),
    ]
)
"""Ball and place: m/s^2; 1/m; of the normal velocity; m, of the ball's centre at a bounce, at the origin, and by how
much it rises along x and y; m, mean and standard deviation of the ball's place; 1/s, standard deviations of the
acceleration by spin for each m/s of speed, zero for none."""
ONE_RAY: Final[Any] = from_dtype(RAY)
RAYS: Final[Any] = from_dtype(RAY)[::1]
SCENE: Final[Any] = from_dtype(NUMBERS)


class Flown(NamedTuple):
    """A path: misfit; logarithm of the share of its prior volume that it has left; as `Paths` has them the others."""

    misfit: float
    narrowed: float
    vectors: Array  # (c, 3)
    drag: Array  # (b + 1,)
    covariance: Array  # (3 c, 3 c)


FLOWN: Final[Any] = types.NamedTuple((REAL, REAL, TWO, ONE, TWO), Flown)


@machine_code(REAL(REAL, ONE, COUNT, ONE, REAL, ONE))
def share_at(moment: float, times: Array, bounces: int, drag: Array, gravity: float, share: Array) -> float:
    """Writes the shares (c,) of the vectors in the position at a moment, s; returns the drop, m, by gravity."""
    later, drop, lift = 0, 0.0, len(share) > bounces + 2
    share[0] = 1.0
    for bounce in range(bounces):
        later += moment > times[bounce]
    for flight in range(bounces + 1):
        stretched = square = 0.0
        if later >= flight if flight else later == 0:
            since = moment - times[max(flight - 1, 0)]
            if 0 < flight < bounces:  # a whole flight for all later moments
                since = min(since, times[flight] - times[flight - 1])
            square, slower = 0.5 * since**2, max(drag[flight] * since, STRETCH_LIMIT)
            # the time in which a ball without drag covers the same way
            stretched = math.log1p(slower) / drag[flight] if drag[flight] > 0.0 else since
            drop += gravity * square / (1.0 + slower / 3.0)
        share[1 + flight] = stretched
        if lift:
            share[bounces + 2 + flight] = square
    return drop


@machine_code(NOTHING(TWO, TWO, COUNT, TWO, REAL, THREE, TWO))
def shares_at(moments, times, bounces, drag, gravity, share, drop):
    """`share_at` for moments (1 or k, n) s of k paths. Writes: share (k, n, c), drop (k, n)."""
    for k in range(len(times)):
        mine = moments[k if len(moments) > 1 else 0]
        for n in range(len(mine)):
            drop[k, n] = share_at(mine[n], times[k], bounces, drag[k], gravity, share[k, n])


@machine_code(NOTHING(ONE, COUNT, COUNT, REAL, SCENE))
def _set(row, vector, axis, value, scene):
    """Writes a row's numbers for a vector along x or y, or, as axis 2, along the normal of the surface."""
    row[3 * vector + axis] = value
    if axis == 2:
        row[3 * vector], row[3 * vector + 1] = -scene.slope[0] * value, -scene.slope[1] * value


@machine_code(REAL(COUNT, SCENE, ONE, COUNT, ONE, ONE))
def _rule(number, scene, times, bounces, drag, row):
    """Writes the whitened row (3 c,) of the equation `number` of the bounces; returns its target."""
    bounce, axis, count = number // RULES, number % RULES, len(row) // 3
    lift, row[:] = count > bounces + 2, 0.0
    if axis == 3:
        share = np.empty(count)
        drop = share_at(times[bounce], times, bounces, drag, scene.gravity, share)
        for vector in range(count):
            _set(row, vector, 2, share[vector] / PLANE_SIGMA, scene)
        return (scene.plane + drop) / PLANE_SIGMA
    flown = times[bounce] - times[max(bounce - 1, 0)]
    slowed, target = 1.0 + drag[bounce] * flown, 0.0
    kept, sigma = (-KEPT, FRICTION_SIGMA) if axis < 2 else (scene.restitution, RESTITUTION_SIGMA)
    _set(row, bounce + 2, axis, 1.0 / sigma, scene)
    _set(row, bounce + 1, axis, kept / slowed / sigma, scene)
    if bounce and lift:
        _set(row, bounces + 2 + bounce, axis, kept * flown / sigma, scene)
    if axis == 2:
        fallen = scene.gravity * flown / (1.0 + drag[bounce] * flown / 2.0)
        target = scene.restitution * fallen / sigma
    return target


@machine_code(REAL(COUNT, SCENE, COUNT, ONE))
def _sigma(number, scene, bounces, speed):
    """Prior standard deviation of one of the unknowns (3 c,) of flights at speeds (b + 1,) m/s."""
    if number < 3:
        return scene.spread
    flight = number // 3 - bounces - 2
    return SPEED if flight < 0 else scene.lift[number % 3] * max(speed[flight], SLOWEST)


@machine_code(NOTHING(SCENE, ONE, COUNT, ONE, ONE, TWO, ONE))
def _prior(scene, times, bounces, drag, speed, information, side):
    """Writes the information (n, n) and its pull (n,) of the wide priors, and of the plane and laws of each bounce."""
    size, row = len(side), np.empty(len(side))
    information[:], side[:] = 0.0, 0.0
    for i in range(size):
        information[i, i] = _sigma(i, scene, bounces, speed) ** -2.0
        if i < 3:
            side[i] = scene.centre[i] * information[i, i]
    for number in range(RULES * bounces):
        target = _rule(number, scene, times, bounces, drag, row)
        for i in range(size):
            if row[i]:
                side[i] += row[i] * target
                for j in range(i + 1):
                    information[i, j] += row[i] * row[j]


@machine_code(REAL(SCENE, ONE, COUNT, ONE, ONE, ONE))
def _off(scene, times, bounces, drag, speed, unknown):
    """Sum of the squares by which unknowns (3 c,) miss their priors, and the laws of the bounces."""
    square, row = 0.0, np.empty(len(unknown))
    for i in range(len(unknown)):
        square += ((unknown[i] - (scene.centre[i] if i < 3 else 0.0)) / _sigma(i, scene, bounces, speed)) ** 2
    for number in range(RULES * bounces):
        left = -_rule(number, scene, times, bounces, drag, row)
        for i in range(len(unknown)):
            left += row[i] * unknown[i]
        square += left**2
    return square


@machine_code(REAL(TWO))
def _root(information):
    """Overwrites the lower half of a positive definite matrix (n, n) by its Cholesky root; returns its log det."""
    size = 0.0
    for i in range(len(information)):
        for j in range(i + 1):
            left = information[i, j]
            for k in range(j):
                left -= information[i, k] * information[j, k]
            information[i, j] = left / information[j, j] if j < i else math.sqrt(left)
        size += 2.0 * math.log(information[i, i])
    return size


@machine_code(NOTHING(TWO, ONE, COUNT))
def _solve(root, side, first):
    """Overwrites a side (n,), zero before `first`, by the solution with the matrix whose root (n, n) is given."""
    for i in range(first, len(side)):
        for j in range(first, i):
            side[i] -= root[i, j] * side[j]
        side[i] /= root[i, i]
    for i in range(len(side) - 1, -1, -1):
        side[i] /= root[i, i]
        for j in range(i):
            side[j] -= root[i, j] * side[i]


@machine_code(NOTHING(ONE_RAY, REAL, REAL, TWO, ONE))
def _whitened(ray, depth, drop, seen, wanted):
    """Writes the equations of a ray, seen (2, 3) and wanted (2,), of a ball without its drop, m, at a depth, m."""
    root = ray.root
    precision = LAWS**2 * (root[0, 0] * root[1, 1] - root[0, 1] * root[1, 0])  # at 1 m, beside that of the laws
    scale = 1.0 / math.sqrt(depth**2 + precision)
    for r in range(2):
        wanted[r] = 0.0
        for a in range(3):
            seen[r, a] = 0.0
        for q in range(2):
            wanted[r] += scale * root[r, q] * (ray.target[q] + ray.matrix[q, 2] * drop)
            for a in range(3):
                seen[r, a] += scale * root[r, q] * ray.matrix[q, a]


@machine_code(NOTHING(RAYS, COUNTS, ONE, ONE, TWO, TWO, ONE))
def _see(rays, rows, depth, weight, shares, information, side):
    """Adds the equations of rays (m,) at depths (m,) m, with weights, to an information (3 c, 3 c) and its pull."""
    count, seen, wanted, both = shares.shape[1] - 1, np.empty((2, 3)), np.empty(2), np.empty((3, 3))
    for n in range(len(rows)):
        _whitened(rays[rows[n]], depth[n], shares[n, count], seen, wanted)
        for c in range(count):
            share = weight[n] * shares[n, c]
            for a in range(3):
                side[3 * c + a] += share * (seen[0, a] * wanted[0] + seen[1, a] * wanted[1])
                for b in range(3):
                    both[a, b] = share * (seen[0, a] * seen[0, b] + seen[1, a] * seen[1, b])
            for d in range(c + 1):
                for a in range(3):
                    for b in range(3):
                        information[3 * c + a, 3 * d + b] += both[a, b] * shares[n, d]


@machine_code(REAL(RAYS, COUNTS, TWO, TWO, ONE, ONE))
def _miss(rays, rows, shares, vectors, depth, weight):
    """Sum of the losses by which a path misses rays (m,); overwrites depth (m,) and weight (m,) by those on it."""
    count, seen, wanted, at, loss = len(vectors), np.empty((2, 3)), np.empty(2), np.empty(3), 0.0
    for n in range(len(rows)):
        ray, square = rays[rows[n]], 0.0
        _whitened(ray, depth[n], shares[n, count], seen, wanted)
        for a in range(3):
            at[a] = 0.0
            for c in range(count):
                at[a] += shares[n, c] * vectors[c, a]
        for r in range(2):
            square += (seen[r, 0] * at[0] + seen[r, 1] * at[1] + seen[r, 2] * at[2] - wanted[r]) ** 2
        at[2] -= shares[n, count]
        row = ray.depth_row
        depth[n] = max(row[0] * at[0] + row[1] * at[1] + row[2] * at[2] + row[3], NEAREST)
        weight[n] = 1.0 / (1.0 + square / ROBUST**2)
        loss -= ROBUST**2 * math.log(weight[n])
    return loss


@machine_code(FLOWN(RAYS, COUNTS, SCENE, ONE, COUNT, FLAG))
def flown(rays, rows, scene, times, bounces, wide):
    """The path through some rays (m,) with bounces at times (b,) s; without bounces `times` is an anchor (1,) s.

    Args: wide: False leaves out the covariance, which takes a third of the time, and the narrowing.
    """
    m, count = len(rows), bounces + 2 + (bounces + 1 if scene.lift[0] > 0.0 else 0)
    size, drag, vectors, shares = 3 * count, np.zeros(bounces + 1), np.empty((count, 3)), np.empty((m, count + 1))
    information, covariance, unknown = np.empty((size, size)), np.empty((size, size)), np.empty(size)
    depth, weight, misfit, known = np.ones(m), np.ones(m), 0.0, 0.0
    speed = np.full(bounces + 1, SPEED)
    for turn in range(ROUNDS):
        for n in range(m):
            shares[n, count] = share_at(rays[rows[n]].time, times, bounces, drag, scene.gravity, shares[n, :count])
        _prior(scene, times, bounces, drag, speed, information, unknown)
        _see(rays, rows, depth, weight, shares, information, unknown)
        known = _root(information)
        _solve(information, unknown, 0)
        vectors[:] = unknown.reshape(count, 3)
        misfit = _miss(rays, rows, shares, vectors, depth, weight)
        if turn == ROUNDS - 1:
            misfit += _off(scene, times, bounces, drag, speed, unknown)
        for flight in range(bounces + 1):
            v = vectors[1 + flight]
            fast = min(math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), 2.0 * SPEED)
            drag[flight] = scene.drag * fast
            if turn < ROUNDS - 1:  # the last solution has the prior of the one before
                speed[flight] = fast
    if not wide:
        return Flown(misfit, 0.0, vectors, drag, covariance)
    for i in range(size):
        covariance[i] = 0.0
        covariance[i, i] = 1.0
        _solve(information, covariance[i], i)
    _prior(scene, times, bounces, drag, speed, information, unknown)
    return Flown(misfit, 0.5 * (_root(information) - known), vectors, drag, covariance)


@machine_code(NOTHING(RAYS, INDEX, SCENE, TWO, COUNT, TWO, THREE, TWO, THREE))
def all_flown(rays, rows, scene, times, bounces, numbers, vectors, drag, covariance):
    """`flown` for times (k, b) s and rays (1 or k, m). Writes: numbers (k, 2), misfit and narrowed, and the others.

    Args: covariance: (k, 3 c, 3 c); (0, 3 c, 3 c) to leave them out.
    """
    wide = len(covariance) > 0
    for k in range(len(times)):
        one = flown(rays, rows[k if len(rows) > 1 else 0], scene, times[k], bounces, wide)
        numbers[k, 0], numbers[k, 1] = one.misfit, one.narrowed
        vectors[k], drag[k] = one.vectors, one.drag
        if wide:
            covariance[k] = one.covariance
