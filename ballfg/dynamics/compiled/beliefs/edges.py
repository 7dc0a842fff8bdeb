"""Decides in machine code whether a ball lies on the table, comes down on it or falls past its ends."""

import math

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.contacts import meet, times_of
from ballfg.dynamics.compiled.flight import glide, put, still, value_of
from ballfg.dynamics.compiled.signatures import FLAG, LAW, LAWS, ONE, REAL, TWO, Laws
from ballfg.dynamics.motion.limits import BEYOND, DEEPEST, LEAST_SIGMA, NEGLIGIBLE, REST_GAP, REST_SPEED
from ballfg.dynamics.surfaces import within


@machine_code(REAL(LAW, ONE, REAL, REAL))
def gap_of(surface, x, level, radius):
    """Gap (m) of a state to a surface."""
    offset = np.empty(3)
    value_of(surface, x, offset)
    return x[2] - level - offset[0] - radius


@machine_code(REAL(LAW, ONE, ONE))
def level_below(surface, x, world):
    """Height (m) of the surface that a ball (9,) falls to; -inf if there is none."""
    return level_at(gap_of(surface, x, 0.0, 0.0), world)


@machine_code(REAL(REAL, ONE))
def level_at(z, world):
    """The same for a centre at z (m), less what surfaces lie above their declared heights there."""
    return world[0] if z > world[0] else lower_level(z, world)


@machine_code(REAL(REAL, ONE))
def lower_level(z, world):
    """Height (m) of what lies below the table under a centre at z (m); -inf if there is nothing."""
    return world[1] if z > world[1] - DEEPEST else -np.inf


@machine_code(FLAG(ONE, ONE))
def over_table(x, world):
    """Whether a state (9,) lies within the table's ends."""
    return within(x[0], x[1], world[3:7])


@machine_code(REAL(ONE, REAL, ONE))
def height_below(x, raised, world):
    """As `Surfaces.height_below`, for one ball (9,): below the table's surface, or beyond its ends, it is beside it."""
    z = x[2] - raised
    return level_at(z, world) if over_table(x, world) else lower_level(z, world)


@machine_code(FLAG(ONE))
def is_slow(x):
    """Whether a state (9,) may be at rest: nearly none is, and their gaps take longer than this look."""
    return abs(x[5]) <= REST_SPEED / 2


@machine_code(FLAG(LAW, LAW, ONE, REAL, ONE))
def stays(rates, surface, x, level, world):
    """True if a state (9,) rests on the surface at a level (m), and its weight keeps it there."""
    if not is_slow(x) or (level == world[0] and not over_table(x, world)):
        return False
    if not abs(gap_of(surface, x, level, world[2])) <= REST_GAP:
        return False
    change = np.empty(6)
    value_of(rates, x, change)
    return change[2] <= 0.0


@machine_code(REAL(ONE, TWO, ONE))
def share_over_table(touch, covariance, world):
    """Probability that a ball with mean `touch` (9,) when it comes down is above the table."""
    within, along = 1.0, np.empty(9)
    for axis in range(2):
        along[:] = 0.0
        along[axis], along[2] = 1.0, -touch[3 + axis] / touch[5]
        variance = 0.0
        for i in range(9):
            for j in range(9):
                variance += along[i] * covariance[i, j] * along[j]
        below = np.empty(2)
        for end in range(2):
            spread = math.sqrt(max(variance, 0.0) + world[7 + 2 * axis + end] ** 2)
            away = (world[3 + 2 * axis + end] - touch[axis]) / max(spread, LEAST_SIGMA)
            below[end] = math.erfc(-away / math.sqrt(2.0)) / 2.0
        within *= max(below[1] - below[0], 0.0)
    return within


@machine_code(REAL(LAWS, ONE, REAL, ONE, ONE))
def come_down(laws, x, level, world, touch):
    """Time (s) at which a falling ball x (9,) reaches a level; writes its state there to touch (9,).

    NaN, with its state unchanged, if it was never above that level.
    """
    tau, state = np.empty(1), x.copy().reshape((1, 9))
    times_of(laws.rates, laws.surface, state, np.full(1, level), np.full(1, BEYOND), world[2], tau)
    put(touch, x)
    if math.isfinite(tau[0]):
        glide(laws.rates, touch, tau[0], 1)
    return tau[0]


@machine_code(FLAG(LAWS, TWO, ONE, REAL, REAL, ONE, ONE, TWO))
def falls_past(laws, covariance, touch, tau, h, world, after, spread):
    """True if a ball's mean falls past the table whose level it reaches at `touch` (9,) after tau s.

    Args: covariance (d, d): before the step of h s.  after (9,): its mean after the step.
    Adds: to the covariance `spread` (d, d) after the step the share of balls that bounce on the table instead, as
        `prediction.propagate` has it. False also where their bounce is not a plain one.
    """
    if over_table(touch, world):
        return False
    share = share_over_table(touch, covariance, world) if tau >= 0.0 else 0.0
    if share < NEGLIGIBLE:
        return True
    none, level, sooner, there = np.empty((1, 9, 0)), world[0], np.empty(1), np.empty((1, 9))
    without = Laws(still(laws.rates), still(laws.impact), still(laws.surface))
    levels, longest = np.full(1, level), np.full(1, BEYOND)
    meet(
        without, touch.copy().reshape((1, 9)), none, levels, longest, world[2], sooner, none[0, :1], there, none.copy()
    )
    if not there[0, 5] >= REST_SPEED:
        return False
    glide(laws.rates, there[0], h - tau - sooner[0], 1)
    if there[0, 5] < 0.0 and not gap_of(laws.surface, there[0], level, world[2]) >= 0.0:
        return False
    for i in range(9):
        for j in range(9):
            spread[i, j] += share * (there[0, i] - after[i]) * (there[0, j] - after[j])
    return True
