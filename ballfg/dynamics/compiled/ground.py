"""Moves balls that roll on a surface, or meet one, in machine code, by the rules of `motion.rollout`."""

import math

import numpy as np

from ballfg.dynamics.compiled.beliefs.edges import (
    gap_of,
    level_below,
    nearest_end,
    over_table,
    speed_over,
    stays,
    time_to_end,
)
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.contacts import common_steps, meet, times_of
from ballfg.dynamics.compiled.flight import evaluate, fly_one, glide, law_at, laws_of, only, put, put_all, still
from ballfg.dynamics.compiled.signatures import (
    COUNT,
    FLAG,
    GIVEN,
    LAW,
    LAWS,
    NOTHING,
    ONE,
    REAL,
    ROLLING,
    THREE,
    TWO,
    Laws,
)
from ballfg.dynamics.motion.limits import LONGEST_FALL, MAX_CONTACTS, REST_SPEED, steps_over


@machine_code(NOTHING(LAW, ONE, TWO, REAL, REAL))
def place_on(surface, x, xt, level, radius):
    """`rollout.place_on` of one ball x (9,) with tangents (9, d), in place."""
    offset, moved = np.empty(3), np.empty((3, xt.shape[1]))
    evaluate(surface, x, xt, offset, moved)
    x[2], x[5] = level + offset[0] + radius, 0.0
    for q in range(xt.shape[1]):
        xt[2, q], xt[5, q] = moved[0, q], 0.0


@machine_code(REAL(LAWS, LAW, ONE, TWO, REAL, ONE, REAL, ONE))
def roll_on(laws, rolling, x, xt, left, leftt, level, world):
    """A ball x (9,) on the surface at a level (m), with tangents (9, d), `left` s later, in place.

    Where it rolls over an end of the table it falls.

    Args: leftt: (d,) tangents of the duration.
    Returns: time (s) for which it rolled.
    """
    place_on(laws.surface, x, xt, level, world[2])
    tau = time_to_end(rolling, x, left, world) if level == world[0] else left
    if not tau < left:
        fly_one(rolling, x, xt, left, leftt, steps_over(abs(left)))
        return left
    d = xt.shape[1]
    at, moved, taut, onward, end = x.copy(), xt.copy(), np.zeros(d), np.zeros(d), np.empty(4)
    fly_one(rolling, at, moved, tau, taut, 1)
    nearest_end(at, world, end)
    speed = speed_over(at, end)
    for q in range(d):  # it passes the end at that time: d place + speed d tau = 0
        taut[q] = -(end[0] * moved[0, q] + end[1] * moved[1, q]) / speed
        onward[q] = leftt[q] - taut[q]
    fly_one(rolling, x, xt, tau, taut, 1)
    fly_one(laws.rates, x, xt, left - tau, onward, 1)
    return tau


@machine_code(NOTHING(*GIVEN, *ROLLING, ONE, ONE, REAL, TWO, THREE))
def roll_rows(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, rolling, g, gt, wg, dt, levels, radius, x, xt):
    """`rollout.roll` of m balls x (m, 9) with tangents (m, 9, d) over dt (m,) s at levels (m,) m, in place."""
    grounded, raised, fixed = law_at(rolling, g, gt, wg), law_at(surface, s, st, ws), np.zeros(xt.shape[2])
    for r in range(len(x)):
        place_on(only(raised, r), x[r], xt[r], levels[r], radius)
        fly_one(only(grounded, r), x[r], xt[r], dt[r], fixed, common_steps(dt))


@machine_code(FLAG(LAWS, ONE, ONE, REAL, ONE))
def _falls_beside(laws, x, after, level, world):
    """Whether a ball x (9,) that comes down to the table's level does so beside the table."""
    if not (level == world[0] and after[5] < 0.0 and gap_of(laws.surface, after, level, world[2]) < 0.0):
        return False
    tau, at = np.empty(1), x.copy()
    times_of(laws.rates, laws.surface, at.reshape((1, 9)), np.full(1, level), np.full(1, LONGEST_FALL), world[2], tau)
    if not math.isnan(tau[0]):
        glide(laws.rates, at, tau[0], steps_over(abs(tau[0])))
    return not over_table(at, world)


@machine_code(COUNT(LAWS, LAW, ONE, TWO, REAL, ONE, ONE, ONE))
def advance_step(laws, rolling, x, xt, h, world, times, levels):
    """A step of h s of one ball x (9,) with tangents (9, d), in place, by the rules of `rollout`.

    Args: world: as in `Carrier`.
    Writes: times and levels (MAX_CONTACTS,) of the bounces after which it rose, in s since the start and m.
    Returns: their number.
    """
    d, bounces, left, level, longest = xt.shape[1], 0, h, level_below(laws.surface, x, world), np.full(1, LONGEST_FALL)
    after, aftert, leftt, tau, taut = x.copy(), xt.copy(), np.zeros(d), np.empty(1), np.empty((1, d))
    for contact in range(MAX_CONTACTS + 1):
        if stays(laws.rates, laws.surface, x, level, world):
            roll_on(laws, rolling, x, xt, left, leftt, level, world)
            return bounces
        put(after, x)
        put_all(aftert, xt)
        fly_one(laws.rates, after, aftert, left, leftt, steps_over(abs(left)))
        if _falls_beside(laws, x, after, level, world):
            level = world[1]
        if contact == MAX_CONTACTS or not (after[5] < 0.0 and gap_of(laws.surface, after, level, world[2]) < 0.0):
            break
        levels[bounces] = level
        meet(
            laws, x.reshape((1, 9)), xt.reshape((1, 9, d)), levels[bounces : bounces + 1], longest, world[2],
            tau, taut, after.reshape((1, 9)), aftert.reshape((1, 9, d)),
        )  # fmt: skip
        lost = math.isnan(tau[0])  # below the surface and never up again
        if lost:
            tau[0] = 0.0
            evaluate(laws.impact, x, xt, after, aftert)
        left -= tau[0]
        for q in range(d):
            leftt[q] -= taut[0, q]
        put(x, after)
        put_all(xt, aftert)
        if lost or x[5] < REST_SPEED or contact == MAX_CONTACTS - 1:
            place_on(laws.surface, x, xt, level, world[2])
        else:
            times[bounces] = h - left
            bounces += 1
    put(x, after)
    put_all(xt, aftert)
    return bounces


@machine_code(COUNT(*GIVEN, *ROLLING, REAL, COUNT, ONE, ONE, TWO, ONE, ONE))
def advance_one(
    rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, rolling, g, gt, wg, h, steps, world, x, xt, times, levels
):
    """`advance_step` of one ball over several steps of h s; times and levels hold `MAX_CONTACTS` of each step."""
    laws, grounded, bounces = (
        laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws),
        law_at(rolling, g, gt, wg),
        0,
    )
    for step in range(steps):
        more = advance_step(laws, grounded, x, xt, h, world, times[bounces:], levels[bounces:])
        for k in range(bounces, bounces + more):
            times[k] += step * h
        bounces += more
    return bounces


@machine_code(NOTHING(LAWS, LAW, ONE, REAL, ONE))
def advance_still(laws, rolling, x, h, world):
    """`advance_step` without tangents."""
    calm = Laws(still(laws.rates), still(laws.impact), still(laws.surface))
    times, levels = np.empty(MAX_CONTACTS), np.empty(MAX_CONTACTS)
    advance_step(calm, still(rolling), x, np.empty((9, 0)), h, world, times, levels)
