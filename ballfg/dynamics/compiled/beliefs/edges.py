"""Decides in machine code whether a ball lies on the table, comes down on it or falls past its ends."""

import math

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.contacts import meet, times_of
from ballfg.dynamics.compiled.flight import glide, put, still, value_of
from ballfg.dynamics.compiled.signatures import FLAG, LAW, LAWS, NOTHING, ONE, REAL, TWO, Laws
from ballfg.dynamics.motion.limits import (
    BEYOND,
    DEEPEST,
    END_STEPS,
    LEAST_SIGMA,
    MIN_SPEED,
    NEGLIGIBLE,
    OVER_AN_END,
    REST_GAP,
    REST_SPEED,
    TIME_TOLERANCE,
)
from ballfg.dynamics.surfaces import within


@machine_code(REAL(LAW, ONE, REAL, REAL))
def gap_of(surface, x, level, radius):
    """Gap (m) of a state to a surface."""
    offset = np.empty(3)
    value_of(surface, x, offset)
    return x[2] - level - offset[0] - radius


@machine_code(REAL(LAW, ONE, ONE), makes_arrays=False)
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


@machine_code(FLAG(LAW, ONE, REAL, ONE), makes_arrays=False)
def lies_on(surface, x, level, world):
    """Whether a state (9,) lies on the surface at a level (m), which has no ends here."""
    return is_slow(x) and abs(gap_of(surface, x, level, world[2])) <= REST_GAP


@machine_code(NOTHING(ONE, ONE, ONE))
def nearest_end(x, world, end):
    """The end of the table that a state (9,) is nearest to, or farthest beyond.

    Writes: to end (4,), x and y of its outward normal; m by which the state is beyond it; m, its standard deviation.
    """
    end[2] = -np.inf
    for k in range(4):
        out = 1.0 if k == 1 or k == 3 else -1.0
        beyond = out * ((x[0] if k < 2 else x[1]) - world[3 + k])
        if beyond > end[2]:
            end[0], end[1], end[2], end[3] = out if k < 2 else 0.0, 0.0 if k < 2 else out, beyond, world[7 + k]


@machine_code(FLAG(ONE, ONE))
def carried(x, world):
    """Whether a state (9,) that lies on the table stays up: its centre is not beyond an end."""
    end = np.empty(4)
    nearest_end(x, world, end)
    return end[2] <= OVER_AN_END


@machine_code(REAL(ONE, ONE))
def speed_over(x, end):
    """m/s, at least `MIN_SPEED`, at which a state (9,) moves out over an end (4,) of the table, as of `nearest_end`."""
    return max(end[0] * x[3] + end[1] * x[4], MIN_SPEED)


@machine_code(REAL(LAW, ONE, REAL, ONE))
def time_to_end(rolling, x, h, world):
    """Time (s) after which a ball x (9,) that rolls on the table falls over an end of it; h if not within h s."""
    at, end = x.copy(), np.empty(4)
    glide(rolling, at, h, 1)
    if not h > 0.0 or carried(at, world):
        return h
    tau = h
    for _ in range(END_STEPS):
        nearest_end(at, world, end)
        later = min(max(tau + (OVER_AN_END - end[2]) / speed_over(at, end), 0.0), h)
        if abs(later - tau) < TIME_TOLERANCE:
            break
        tau = later
        put(at, x)
        glide(rolling, at, tau, 1)
    return tau


@machine_code(FLAG(LAW, LAW, ONE, REAL, ONE))
def stays(rates, surface, x, level, world):
    """True if a state (9,) rests on the surface at a level (m), and its weight keeps it there."""
    if not lies_on(surface, x, level, world) or (level == world[0] and not carried(x, world)):
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
