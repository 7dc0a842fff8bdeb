"""The functions of a C header, as `c_header.py` translates them: flight, contact, prediction and the way to a plane.

They call the functions that numba compiles for ballfg's own predictions; only C runs them.
"""

import math

import numpy as np

from ballfg.dynamics.compiled.beliefs.carry import carry
from ballfg.dynamics.compiled.beliefs.events import FOUND, INSTANT, NONE, find
from ballfg.dynamics.compiled.beliefs.mixture import mix
from ballfg.dynamics.compiled.contacts import meet
from ballfg.dynamics.compiled.flight import fly_one, put
from ballfg.dynamics.motion.limits import LONGEST_FALL, LONGEST_MOTION, steps_over


def unit(jacobian):
    """Derivatives of a state by itself."""
    for i in range(9):
        for j in range(9):
            jacobian[i, j] = 1.0 if i == j else 0.0


def finite(state, matrix):
    """True if all are finite."""
    total = 0.0
    for i in range(9):
        total += 0.0 * state[i]
        for j in range(9):
            total += 0.0 * matrix[i, j]
    return total == 0.0


def fly(laws, state, dt, after, jacobian):
    """Free flight. Without surfaces; dt may be negative. Returns 1; 0: |dt| > 20 s, or a number is not finite."""
    if not abs(dt) <= LONGEST_MOTION:
        return False
    put(after, state)
    unit(jacobian)
    fly_one(laws.rates, after, jacobian, dt, np.zeros(9), steps_over(abs(dt)))
    return finite(after, jacobian)


def contact(laws, radius, state, height, longest, tau, after, jacobian):
    """The next contact of a ball with a surface at a height, or the last one if it is below, up to `longest` s away.

    Returns 1; 0: none within that time or within 20 s, or an argument that is no number.
    """
    time, no_change, moved = np.empty(1), np.empty((1, 9)), np.empty((9, 9))
    if not longest > 0.0:
        return False
    unit(moved)
    heights, furthest = np.full(1, height), np.full(1, min(longest, LONGEST_FALL))
    meet(
        laws, state.reshape((1, 9)), moved.reshape((1, 9, 9)), heights, furthest, radius,
        time, no_change, after.reshape((1, 9)), jacobian.reshape((1, 9, 9)),
    )  # fmt: skip
    tau[0] = time[0]
    return math.isfinite(time[0]) and finite(after, jacobian)


def predict(laws, rolling, world, noise, state, covariance, count, times, states, covariances):
    """States and covariances of a ball at `count` times (s from now, not decreasing), through plain bounces."""
    rates, impact, surface = laws
    mean, spread, beside, besides = (
        np.empty((2, 1, 9)), np.empty((2, 1, 9, 9)), np.empty((2, 1, 9)), np.empty((2, 1, 9, 9)),
    )  # fmt: skip
    level, age, hard, h = np.full((2, 1), np.nan), np.full((2, 1), np.nan), np.zeros(1), np.empty((1, 1))
    mean[0, 0], spread[0, 0] = state, covariance
    beside[0], besides[0] = mean[0], spread[0]
    before = 0.0
    for k in range(count):
        if not 0.0 <= times[k] - before <= LONGEST_MOTION:
            return k
        steps = steps_over(times[k] - before)
        h[0, 0] = (times[k] - before) / steps
        before = times[k]
        for _ in range(steps):
            if carry(
                rates.compute, impact.compute, surface.compute, rates.c, rates.ct, impact.c, impact.ct,
                surface.c, surface.ct, rates.w, impact.w, surface.w,
                rolling.compute, rolling.c, rolling.ct, rolling.w,
                h, world, noise, mean, spread, beside, besides, level, age, hard,
            ) != 1:  # fmt: skip
                return k
            mean[0], spread[0], beside[0], besides[0] = mean[1], spread[1], beside[1], besides[1]
            level[0], age[0] = level[1], age[1]
        states[k], covariances[k] = mean[1, 0], spread[1, 0]
        mix(
            rates.compute, impact.compute, surface.compute, rates.c, rates.ct, impact.c, impact.ct,
            surface.c, surface.ct, rates.w, impact.w, surface.w, world, noise, states[k].reshape((1, 1, 9)),
            covariances[k].reshape((1, 1, 9, 9)), beside[1:], besides[1:], level[1:], age[1:],
        )  # fmt: skip
        if not finite(states[k], covariances[k]):
            return k
    return count


def cross_plane(
    laws, rolling, world, noise, state, covariance, normal, offset, direction, horizon, time, time_sigma, there, spread
):  # fmt: skip
    """The next crossing of the plane normal . p = offset by the ball's centre.

    The covariance is projected onto the plane, as `crossing.plane_crossing` does.
    """
    line, rate, moved = np.zeros(9), np.empty(9), np.empty(9)
    ends, means, spreads = np.full(1, np.nan), np.empty((1, 9)), np.empty((1, 9, 9))
    length = math.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    sign = -1.0 if direction > 0 else 1.0
    if not (length > 0.0 and math.isfinite(length + offset) and horizon > 0.0 and math.isfinite(horizon)):
        return -1
    for i in range(3):
        line[i] = sign * (normal[i] / length)
    put(there, state)
    spread[:] = covariance
    rates, impact, surface = laws
    end, elapsed = find(
        rates.compute, impact.compute, surface.compute, rates.c, rates.ct, impact.c, impact.ct,
        surface.c, surface.ct, rates.w, impact.w, surface.w,
        rolling.compute, rolling.c, rolling.ct, rolling.w,
        False, direction == 0, line, sign * (offset / length), INSTANT, horizon, world, noise, there, spread, rate,
        ends, means, spreads,
    )  # fmt: skip
    time[0], time_sigma[0] = elapsed, np.inf
    if end != FOUND:
        return 0 if end == NONE else -1
    if not finite(there, spread):
        return -1
    closing = 0.0
    for i in range(9):
        closing += line[i] * rate[i]
    if closing == 0.0:
        return 1
    variance = 0.0
    for i in range(9):
        moved[i] = 0.0  # covariance of the state with the time of the crossing
        for j in range(9):
            moved[i] -= spread[i, j] * line[j] / closing
    for i in range(9):
        variance -= moved[i] * line[i] / closing
    for i in range(9):
        for j in range(9):
            spread[i, j] += rate[i] * moved[j] + moved[i] * rate[j] + variance * rate[i] * rate[j]
    time_sigma[0] = math.sqrt(max(variance, 0.0))
    return 1
