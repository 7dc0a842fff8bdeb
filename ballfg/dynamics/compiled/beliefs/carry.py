"""Carries means and covariances of balls forward in machine code, through flight, plain bounces and rest.

Within the uncertainty of a ball that bounces, some balls have not bounced yet. For a while, a second ball that flies on
through the surface, *unbounced*, stands for them: `mixture.py` uses it.
"""

import numpy as np

from ballfg.dynamics.compiled.beliefs import edges
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.contacts import meet, times_of
from ballfg.dynamics.compiled.flight import (
    fly_one,
    glide,
    law_at,
    laws_of,
    laws_of_one,
    only,
    still,
    value_of,
    white_acceleration,
)
from ballfg.dynamics.compiled.ground import place_on, roll_on
from ballfg.dynamics.compiled.signatures import (
    COUNT,
    FLAG,
    FOUR,
    GIVEN,
    LAW,
    LAWS,
    NOTHING,
    ONE,
    REAL,
    ROLLING,
    THREE,
    TWO,
    Law,
)
from ballfg.dynamics.motion.limits import BEYOND, NEGLIGIBLE, REST_SPEED


@machine_code(NOTHING(TWO, TWO, TWO))
def through(jacobian, covariance, after):
    """J P J^T of covariance P (d, d), with J (9, d) of the state; coefficients stay. Writes after (d, d)."""
    d = len(covariance)
    half = covariance.copy()  # J P
    for i in range(9):
        for j in range(d):
            total = 0.0
            for q in range(d):
                total += jacobian[i, q] * covariance[q, j]
            half[i, j] = total
    for i in range(d):
        for j in range(min(i + 1, 9)):
            total = 0.0
            for q in range(d):
                total += half[i, q] * jacobian[j, q]
            after[i, j] = after[j, i] = total
        for j in range(9, i + 1):
            after[i, j] = after[j, i] = 0.5 * (half[i, j] + half[j, i])


@machine_code(NOTHING(TWO, REAL, ONE))
def add_flight(covariance, h, noise):
    """Add what h s of free flight gather; noise (5,) as in `carry`."""
    position, between, velocity = white_acceleration(h, noise[0] ** 2)
    spin = noise[1] ** 2
    for i in range(3):
        covariance[i, i] += position
        covariance[3 + i, i] += between
        covariance[i, 3 + i] += between
        covariance[3 + i, 3 + i] += velocity
        covariance[6 + i, 6 + i] += spin * h


@machine_code(NOTHING(TWO, REAL, ONE))
def add_impact(covariance, since, noise):
    """Adds the effect of an impact's noise `since` s later; noise (5,) as in `carry`."""
    for i in range(3):
        velocity = noise[3] if i < 2 else noise[2]
        covariance[i, i] += (since * velocity) ** 2
        covariance[3 + i, i] += since * velocity**2
        covariance[i, 3 + i] += since * velocity**2
        covariance[3 + i, 3 + i] += velocity**2
        covariance[6 + i, 6 + i] += noise[4] ** 2


@machine_code(FLAG(LAWS, ONE, TWO, REAL, REAL, ONE, ONE, ONE, TWO))
def bounce(laws, start, covariance, h, level, world, noise, x, after):
    """One ball (9,), with its covariance, that comes down on a level within h s, or has done so just before.

    Writes: its state x (9,) and covariance after (d, d) at the end.
    Returns: whether this is a plain bounce: one, within the table's ends, after which the ball rises. The covariance
        has the share of balls that fall past an end instead, as `prediction.propagate` has it.
    """
    d, radius, rates = len(covariance), world[2], laws.rates
    tau, taut, there, moved = np.empty(1), np.empty((1, d)), np.empty((1, 9)), np.zeros((1, 9, d))
    touch, jacobian, gathered = start.copy().reshape((1, 9)), np.zeros((1, 9, d)), np.empty((d, d))
    levels, longest = np.full(1, level), np.full(1, BEYOND)
    times_of(rates, laws.surface, touch, levels, longest, radius, tau)
    if not -BEYOND <= tau[0] <= h:
        return False
    elapsed = tau[0]
    for i in range(9):
        jacobian[0, i, i] = 1.0
    moved[:] = jacobian
    fly_one(rates, touch[0], jacobian[0], elapsed, np.zeros(d), 1)
    if not touch[0, 5] < 0.0:
        return False
    past = 0.0  # share of balls that miss the table
    if level == world[0] and elapsed >= 0.0:
        past = 1.0 - edges.share_over_table(touch[0], covariance, world)
        if not past < NEGLIGIBLE and not edges.over_table(touch[0], world):
            return False
    through(jacobian[0], covariance, gathered)
    add_flight(gathered, max(elapsed, 0.0), noise)
    jacobian[:] = moved
    meet(laws, touch, jacobian, levels, longest, radius, tau, taut, there, moved)
    if not there[0, 5] >= REST_SPEED:
        return False
    left = h - (elapsed + tau[0])
    fly_one(rates, there[0], moved[0], left, -taut[0], 1)
    x[:] = there[0]
    if x[5] < 0.0 and not edges.gap_of(laws.surface, x, level, radius) >= 0.0:
        return False
    through(moved[0], gathered, after)
    add_flight(after, min(left, h), noise)
    add_impact(after, min(left, h), noise)
    if not past < NEGLIGIBLE:
        beside = start.copy()
        glide(rates, beside, h, 1)
        for i in range(9):
            for j in range(9):
                after[i, j] += past * (x[i] - beside[i]) * (x[j] - beside[j])
    return True


@machine_code(NOTHING(LAW, ONE, TWO, REAL, ONE, ONE, TWO))
def fly_belief(rates, mean, covariance, h, noise, after, spread):
    """Free flight of one ball over h s. Writes its mean (d,) and covariance (d, d)."""
    d = len(mean)
    jacobian = np.zeros((9, d))
    for i in range(9):
        jacobian[i, i] = 1.0
    after[:] = mean
    fly_one(rates, after[:9], jacobian, h, np.zeros(d), 1)
    through(jacobian, covariance, spread)
    add_flight(spread, h, noise)


@machine_code(NOTHING(LAW, LAW, ONE, TWO, REAL, REAL, ONE, REAL, ONE, TWO))
def roll_belief(surface, rolling, mean, covariance, h, level, noise, radius, after, spread):
    """`fly_belief` at rest on the surface at a level (m), as if it had no ends."""
    d = len(mean)
    jacobian = np.zeros((9, d))
    for i in range(9):
        jacobian[i, i] = 1.0
    after[:] = mean
    place_on(surface, after[:9], jacobian, level, radius)
    fly_one(rolling, after[:9], jacobian, h, np.zeros(d), 1)
    through(jacobian, covariance, spread)
    add_flight(spread, h, noise)


@machine_code(NOTHING(LAWS, LAW, ONE, TWO, REAL, REAL, ONE, ONE, ONE, TWO))
def _go_on(laws, rolling, mean, covariance, h, level, world, noise, after, spread):
    """A neighbour h s later, as if its surface at a level (m) had no ends, or were not there: it rolls on, or flies."""
    if edges.lies_on(laws.surface, mean[:9], level, world):
        roll_belief(laws.surface, rolling, mean, covariance, h, level, noise, world[2], after, spread)
    else:
        fly_belief(laws.rates, mean, covariance, h, noise, after, spread)


@machine_code(NOTHING(LAWS, LAW, ONE, REAL, REAL, REAL, ONE, TWO))
def _add_end(laws, rolling, x, h, tau, level, world, spread):
    """Adds to a covariance (d, d) h s later what the uncertain end does to a ball x (9,) that falls after tau s."""
    at, rolls, falls, moved, end = x.copy(), np.empty(6), np.empty(6), np.zeros((9, 1)), np.empty(4)
    place_on(still(laws.surface), at, np.empty((9, 0)), level, world[2])
    glide(rolling, at, tau, 1)
    value_of(rolling, at, rolls)
    value_of(laws.rates, at, falls)
    edges.nearest_end(at, world, end)
    late = end[3] / edges.speed_over(at, end)  # s
    for i in range(6):
        moved[3 + i, 0] = (rolls[i] - falls[i]) * late
    law = laws.rates
    along = Law(law.compute, law.c, np.zeros((1, law.c.shape[1], 1)), law.w)
    fly_one(along, at, moved, h - tau, np.zeros(1), 1)
    for i in range(9):
        for j in range(9):
            spread[i, j] += moved[i, 0] * moved[j, 0]


@machine_code(NOTHING(LAWS, LAW, ONE, TWO, REAL, REAL, ONE, ONE, ONE, TWO))
def roll_off(laws, rolling, mean, covariance, h, level, world, noise, after, spread):
    """`roll_belief` on a surface with its ends: where the mean rolls over one it falls."""
    d = len(mean)
    jacobian = np.zeros((9, d))
    for i in range(9):
        jacobian[i, i] = 1.0
    after[:] = mean
    tau = roll_on(laws, rolling, after[:9], jacobian, h, np.zeros(d), level, world)
    through(jacobian, covariance, spread)
    add_flight(spread, h, noise)
    if tau < h:
        _add_end(laws, rolling, mean[:9], h, tau, level, world, spread)


@machine_code(COUNT(*GIVEN, *ROLLING, TWO, ONE, ONE, THREE, FOUR, THREE, FOUR, TWO, TWO, ONE))
def carry(
    rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, rolling, g, gt, wg,
    h, world, noise, mean, covariance, beside, besides, level, age, hard,
):  # fmt: skip
    """Carry n balls on by k steps of at most `MAX_STEP`, from the first row of each array to the next ones.

    Args:
        c, b, s, g: coefficients of rates, impact, surface and rolling, (n, p) with tangents (n, p, d); w, wb, ws, wg:
            their weights.
        h (n, k): s, the steps.
        world (11,): m, heights of the table and of what lies below it (-inf: nothing), the ball's radius, the table's
            extent (x_low, x_high, y_low, y_high), the standard deviations of its ends.
        noise (5,): densities of the acceleration (m/s^2/sqrt(Hz)) and the spin (rad/s/sqrt(s)); of an impact along the
            vertical and along the surface (m/s), and of the spin (rad/s).
    Writes: mean (k + 1, n, d) and covariance (k + 1, n, d, d); for balls that fly on unbounced, or roll on beyond an
        end, beside and besides, of the same shapes, the surface's level (k + 1, n) m and age (k + 1, n) s since then,
        NaN where there is none.
    Returns: the number of steps done. Where that is less than k, hard (n,) is 1 for balls that have not done the next
        one, since their bounce is not a plain one.
    """
    n, touch, all_laws = mean.shape[1], np.empty(9), laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws)
    grounded = law_at(rolling, g, gt, wg)
    for k in range(h.shape[1]):
        stop = False
        for r in range(n):
            x, step, laws, own = mean[k, r], h[r, k], laws_of_one(all_laws, r), only(grounded, r)
            fly_belief(laws.rates, x, covariance[k, r], step, noise, mean[k + 1, r], covariance[k + 1, r])
            age[k + 1, r] = age[k, r] + step
            if age[k + 1, r] < BEYOND:
                level[k + 1, r] = level[k, r]
                _go_on(laws, own, beside[k, r], besides[k, r], step, level[k, r], world, noise,
                       beside[k + 1, r], besides[k + 1, r])  # fmt: skip
            else:
                age[k + 1, r] = np.nan
            low, after = edges.level_below(laws.surface, x[:9], world), mean[k + 1, r]
            if edges.stays(laws.rates, laws.surface, x[:9], low, world):
                spread = covariance[k + 1, r]
                roll_belief(laws.surface, own, x, covariance[k, r], step, low, noise, world[2], after, spread)
                if low == world[0] and not edges.carried(after, world):
                    beside[k + 1, r], besides[k + 1, r] = after, spread
                    level[k + 1, r], age[k + 1, r] = low, 0.0
                    roll_off(laws, own, x, covariance[k, r], step, low, world, noise, after, spread)
                continue
            if after[5] >= 0.0 or edges.gap_of(laws.surface, after[:9], low, world[2]) >= 0.0:
                continue
            if low == world[0] and edges.gap_of(laws.surface, after[:9], world[1], world[2]) >= 0.0:
                tau = edges.come_down(laws, x[:9], low, world, touch)
                if edges.falls_past(laws, covariance[k, r], touch, tau, step, world, after, covariance[k + 1, r]):
                    continue
            beside[k + 1, r], besides[k + 1, r] = after, covariance[k + 1, r]
            level[k + 1, r], age[k + 1, r] = low, 0.0
            if not bounce(laws, x[:9], covariance[k, r], step, low, world, noise, after[:9], covariance[k + 1, r]):
                hard[r], stop = 1.0, True
        if stop:
            return k
    return h.shape[1]
