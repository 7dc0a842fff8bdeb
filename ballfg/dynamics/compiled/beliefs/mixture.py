"""Mixes the beliefs of balls that have bounced and of those that have not, near a contact of uncertain time.

The linear propagation takes all balls to be on the mean's side of the contact. Near the contact a belief is therefore
reported as a mixture of both sides, by its mean and covariance (docs/derivations/prediction.md).
"""

import math

import numpy as np

from ballfg.dynamics.compiled.beliefs.carry import add_impact, through
from ballfg.dynamics.compiled.beliefs.edges import (
    come_down,
    gap_of,
    level_below,
    lies_on,
    nearest_end,
    over_table,
    share_over_table,
    speed_over,
)
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.contacts import meet
from ballfg.dynamics.compiled.flight import evaluate, fly_one, laws_of, laws_of_one, value_of
from ballfg.dynamics.compiled.signatures import FLAG, FOUR, GIVEN, LAW, LAWS, NOTHING, ONE, REAL, THREE, TWO, Law, Laws
from ballfg.dynamics.motion.limits import BEYOND, LEAST_SIGMA, MIN_SPEED, NEGLIGIBLE, OVER_AN_END

FAR = 4.5
"""Standard deviations of the gap beyond which all balls count as being on one side of a contact. At 4.5, one ball in
300,000 is on the other side. With a jump of 5 m/s, 9 mm/s of a velocity's sigma are left out.
At 4 it would be 28 mm/s, as much as a usual sigma."""


@machine_code(REAL(LAW, ONE, TWO, REAL, REAL, ONE))
def _below(surface, mean, covariance, level, radius, k):
    """Writes k (d,) and returns c: a ball at k u off its mean (u standard normal) is below the surface where u < c."""
    d = len(mean)
    xt, offset, moved, gradient = np.zeros((9, d)), np.empty(3), np.empty((3, d)), np.empty(d)
    for i in range(9):
        xt[i, i] = 1.0
    evaluate(surface, mean[:9], xt, offset, moved)
    for q in range(d):
        gradient[q] = xt[2, q] - moved[0, q]
    variance = 0.0
    for i in range(d):
        k[i] = 0.0
        for q in range(d):
            k[i] += covariance[i, q] * gradient[q]
        variance += gradient[i] * k[i]
    sigma = math.sqrt(max(variance, LEAST_SIGMA**2))
    for i in range(d):
        k[i] /= sigma
    return -(mean[2] - level - offset[0] - radius) / sigma


@machine_code(NOTHING(ONE, TWO, REAL, ONE, REAL, ONE, TWO))
def _one_side(mean, covariance, c, k, u, part, spread):
    """Mean and covariance of the balls on one side of the surface, where the standard normal of `_below` has mean u.

    A normal cut at c whose mean is u has the variance 1 + u (c - u), on either side.
    """
    for i in range(len(mean)):
        part[i] = mean[i] + u * k[i]
        for j in range(len(mean)):
            spread[i, j] = covariance[i, j] + u * (c - u) * k[i] * k[j]


@machine_code(LAW(LAW, ONE))
def _moved(law, change):
    """The law of one ball after a change (d,) of state and coefficients."""
    moved = law.c.copy()
    for i in range(moved.shape[1]):
        for q in range(len(change)):
            moved[0, i] += law.ct[0, i, q] * change[q]
    return Law(law.compute, moved, law.ct, law.w)


@machine_code(FLAG(LAWS, ONE, ONE, TWO, REAL, ONE, ONE))
def _bounced(of_mean, change, mean, covariance, level, world, noise):
    """Moves balls below the surface through their past bounce, linear about their mean.

    Args: of_mean: laws of the mean on both sides, from which theirs differ by a change (d,).
    Returns: False if this does not describe them: they would bounce a second time, or never came down.
    """
    d, radius = len(mean), world[2]
    laws = Laws(_moved(of_mean.rates, change), _moved(of_mean.impact, change), _moved(of_mean.surface, change))
    tau, taut, there, moved = np.empty(1), np.empty((1, d)), np.empty((1, 9)), np.zeros((1, 9, d))
    start, still = mean[:9].copy().reshape((1, 9)), np.zeros((1, 9, d))
    for i in range(9):
        still[0, i, i] = 1.0
    meet(laws, start, still, np.full(1, level), np.full(1, BEYOND), radius, tau, taut, there, moved)
    if not tau[0] <= 0.0:
        return False
    fly_one(laws.rates, there[0], moved[0], -tau[0], -taut[0], 1)
    if not gap_of(laws.surface, there[0], level, radius) >= 0.0:
        return False
    mean[:9] = there[0]
    spread = np.empty((d, d))
    through(moved[0], covariance, spread)
    covariance[:] = spread
    add_impact(covariance, -tau[0], noise)
    return True


@machine_code(REAL(LAWS, ONE, TWO, REAL, ONE))
def _past(laws, mean, covariance, level, world):
    """Share of balls that miss the table at a level (m), some time before or after the mean comes down there."""
    if level != world[0]:
        return 0.0
    d, touch = len(mean), np.empty(9)
    tau = come_down(laws, mean[:9], level, world, touch)
    if not (math.isfinite(tau) and touch[5] < 0.0):
        return 0.0
    then, there = np.zeros((9, d)), np.empty((d, d))
    for i in range(9):
        then[i, i] = 1.0
    for i in range(3):
        then[i, 3 + i] = tau
    through(then, covariance, there)
    past = 1.0 - share_over_table(touch, there, world)
    return 0.0 if past < NEGLIGIBLE else past


@machine_code(NOTHING(LAW, ONE, TWO, FLAG, ONE, ONE, TWO))
def _fall_past(rates, rolled, rolleds, has_left, world, mean, covariance):
    """Writes mean (d,) and covariance (d, d) of balls that roll over an end of the table, each at its own moment.

    A ball has fallen for s = T (c + u), if that is positive, with u standard normal.

    Args: rolled (d,), rolleds (d, d): of balls that roll on beyond the end.  has_left: whether the mean has fallen.
    """
    d, along, pull, end = len(mean), np.empty(len(mean)), np.empty(6), np.empty(4)
    nearest_end(rolled[:9], world, end)
    speed = speed_over(rolled[:9], end)
    if not speed > MIN_SPEED:
        return
    since = (end[2] - OVER_AN_END) / speed
    for i in range(d):  # covariance with the moment of the fall
        along[i] = end[0] * (rolleds[i, 0] - since * rolleds[i, 3]) + end[1] * (rolleds[i, 1] - since * rolleds[i, 4])
        along[i] /= speed
    variance = end[0] * (along[0] - since * along[3]) + end[1] * (along[1] - since * along[4])
    variance = variance / speed + (end[3] / speed) ** 2
    late = math.sqrt(max(variance, LEAST_SIGMA**2))  # T
    if not abs(since) < FAR * late:
        return
    value_of(rates, rolled[:9], pull)
    c, fall = since / late, pull[2]
    share, density = math.erfc(-c / math.sqrt(2.0)) / 2.0, math.exp(-c * c / 2.0) / math.sqrt(2.0 * math.pi)
    first = late * (c * share + density)  # moments of s
    second = late**2 * ((c * c + 1.0) * share + c * density)
    third = late**3 * ((c**3 + 3.0 * c) * share + (c * c + 2.0) * density)
    fourth = late**4 * ((c**4 + 6.0 * c * c + 3.0) * share + (c**3 + 5.0 * c) * density)
    for i in range(d):
        mean[i] = rolled[i] + (share * (mean[i] - rolled[i]) if has_left else 0.0)
        for j in range(d):
            covariance[i, j] = rolleds[i, j]
    for i in range(d):  # Stein's lemma: a function of s varies with all else as its mean slope does
        for row, slope in ((2, first), (5, share)):
            covariance[i, row] += fall * slope * along[i]
            covariance[row, i] += fall * slope * along[i]
    mean[2], mean[5] = rolled[2] + 0.5 * fall * second, fall * first
    covariance[2, 2] += 0.25 * fall**2 * (fourth - second**2)
    covariance[2, 5] += 0.5 * fall**2 * (third - first * second)
    covariance[5, 2] += 0.5 * fall**2 * (third - first * second)
    covariance[5, 5] += fall**2 * (second - first**2)


@machine_code(FLAG(LAWS, REAL, REAL, ONE, TWO, ONE, ONE, TWO, ONE, TWO))
def _rolls(laws, age, level, beside, besides, world, rolled, rolleds, mean, covariance):
    """Whether a ball rolls on the table, or has fallen over its end a short while ago; if so writes its moments.

    Args: age, level, beside, besides: of its neighbour.  Writes: to rolled (d,) and rolleds (d, d), too.
    """
    fallen = age >= 0.0 and lies_on(laws.surface, beside[:9], level, world)
    if not (fallen or lies_on(laws.surface, mean[:9], world[0], world)):
        return False
    rolled[:], rolleds[:] = mean, covariance
    if fallen:
        rolled[:], rolleds[:] = beside, besides
    _fall_past(laws.rates, rolled, rolleds, fallen, world, mean, covariance)
    return True


@machine_code(NOTHING(REAL, ONE, TWO, ONE, TWO, ONE, TWO))
def _join(share, above, aboves, below, belows, mean, covariance):
    """Mean (d,) and covariance (d, d) of a mixture with a share of `below`; unchanged if the share is not a number."""
    d, total = len(above), 0.0
    for i in range(d):
        for j in range(d):
            outer = (below[i] - above[i]) * (below[j] - above[j])
            belows[i, j] = share * belows[i, j] + (1.0 - share) * (aboves[i, j] + share * outer)
            total += belows[i, j]
    if not math.isfinite(total):
        return
    for i in range(d):
        mean[i] = above[i] + share * (below[i] - above[i])
        for j in range(d):
            covariance[i, j] = (belows[i, j] + belows[j, i]) / 2.0


@machine_code(NOTHING(*GIVEN, ONE, ONE, THREE, FOUR, THREE, FOUR, TWO, TWO))
def mix(
    rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, world, noise, mean, covariance, beside, besides, level, age
):
    """Writes the mean and covariance of the mixture for balls that may or may not have bounced, in place.

    Args: as `carry`, of any number of times.
    """
    d, all_laws = mean.shape[2], laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws)
    k, own, falling = np.empty(d), np.empty(d), np.empty(d)
    above, aboves, below, belows = np.empty(d), np.empty((d, d)), np.empty(d), np.empty((d, d))
    for time in range(mean.shape[0]):
        for r in range(mean.shape[1]):
            at, spread, c0, low, laws = mean[time, r], covariance[time, r], np.inf, np.nan, laws_of_one(all_laws, r)
            other, others = beside[time, r], besides[time, r]
            if _rolls(laws, age[time, r], level[time, r], other, others, world, below, belows, at, spread):
                continue
            if age[time, r] >= 0.0:
                low = level[time, r]
                below[:], belows[:] = beside[time, r], besides[time, r]
                c0 = _below(laws.surface, below, belows, low, world[2], k)
            under = level_below(laws.surface, at[:9], world)
            if at[5] < 0.0 and math.isfinite(under) and (under != world[0] or over_table(at, world)):
                c1 = _below(laws.surface, at, spread, under, world[2], own)
                if abs(c1) < abs(c0):  # of two contacts of a ball the nearer one
                    c0, low = c1, under
                    k[:], below[:], belows[:] = own, at, spread
            if not abs(c0) < FAR:
                continue
            share = math.erfc(-c0 / math.sqrt(2.0)) / 2.0
            density = math.exp(-c0 * c0 / 2.0) / math.sqrt(2.0 * math.pi)
            _one_side(below, belows, c0, k, density / (1.0 - share), above, aboves)
            _one_side(below, belows, c0, k, -density / share, below, belows)
            for i in range(d):
                own[i] = -density / share * k[i]
            falling[:], past = below, _past(laws, below, belows, low, world)
            if _bounced(laws, own, below, belows, low, world, noise):
                for i in range(9):
                    for j in range(9):
                        belows[i, j] += past * (below[i] - falling[i]) * (below[j] - falling[j])
                _join(share, above, aboves, below, belows, at, spread)
