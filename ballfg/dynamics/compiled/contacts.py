"""Finds contacts with surfaces and moves balls through them in machine code, by the rules of `motion.contact`."""

import math

import numpy as np
from numba import types

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import (
    evaluate,
    fly_one,
    fly_together,
    glide,
    law_at,
    laws_of,
    only,
    put,
    put_all,
    value_of,
)
from ballfg.dynamics.compiled.signatures import (
    ADDRESS,
    COUNT,
    COUNTS,
    FLAG,
    GIVEN,
    LAW,
    LAWS,
    NOTHING,
    ONE,
    REAL,
    THREE,
    TWO,
    Law,
    several,
)
from ballfg.dynamics.motion import limits

LEAST = 1e-300  # Keeps a division by zero away


@machine_code(several(REAL, 3)(LAW, LAW, ONE, REAL, REAL))
def _approach(rates, surface, x, height, radius):
    """Gap (m) of a state to a surface, its rate (m/s) and the acceleration (m/s^2) with which it closes."""
    a, o = np.empty(6), np.empty(3)
    value_of(rates, x, a)
    value_of(surface, x, o)
    gap = x[2] - height - o[0] - radius
    rate = x[5] - o[1] * x[3] - o[2] * x[4]
    return gap, rate, -(a[2] - o[1] * a[0] - o[2] * a[1])


@machine_code(COUNT(ONE))
def common_steps(durations):
    """The number of steps for the longest of some durations; NaN needs none."""
    longest = 0.0
    for duration in durations:
        if abs(duration) > longest:
            longest = abs(duration)
    return limits.steps_over(longest)


@machine_code(NOTHING(LAW, LAW, TWO, ONE, REAL, ONE, ONE))
def _search(rates, surface, state, heights, radius, longest, tau):
    """Times (s) of contacts near tau, in place: each step solves the parabola through the motion there. NaN: none.

    All rows take the same number of integration steps, as they do in torch: a time is exact for its steps.
    """
    m = len(tau)
    lost, arrived, at = np.empty(m, dtype=np.bool_), np.zeros(m, dtype=np.bool_), np.empty(9)
    for r in range(m):
        lost[r] = math.isnan(tau[r])
        tau[r] = 0.0 if lost[r] else tau[r]
    for _ in range(limits.SEARCH_STEPS):
        steps, searching = common_steps(tau), False
        for r in range(m):
            put(at, state[r])
            if tau[r] != 0.0:
                glide(only(rates, r), at, tau[r], steps)
            gap, rate, fall = _approach(only(rates, r), only(surface, r), at, heights[r], radius)
            used = max(fall, limits.LEAST_FALL)
            square = rate * rate + 2.0 * used * gap
            root = math.sqrt(max(square, 0.0))
            comes = rate < 0.0 and square > 0.0
            move = 2.0 * gap / max(root - rate, LEAST) if comes else (rate + root) / used
            error = (limits.TYPICAL_JERK / 6.0 * abs(move) + abs(used - fall) / 2.0) * move * move
            settled = abs(gap) < limits.GAP_TOLERANCE and abs(move) < limits.MIN_SPEED
            arrived[r] = (comes and error < limits.TIME_TOLERANCE * abs(rate)) or settled
            if lost[r] or not abs(tau[r] + move) <= longest[r]:
                lost[r], tau[r] = True, 0.0
            else:
                tau[r] += move
            searching = searching or not (arrived[r] or lost[r])
        if not searching:
            break
    for r in range(m):
        if lost[r] or not arrived[r]:
            tau[r] = np.nan


@machine_code(REAL(LAW, LAW, ONE, REAL, REAL, REAL))
def _scan(rates, surface, state, height, radius, longest):
    """Time (s) of the contact within one step, by small steps; NaN if the ball turns before it touches."""
    at = state.copy()
    gap, rate, _ = _approach(rates, surface, at, height, radius)
    forward = not (gap < 0.0 and rate < 0.0)
    step = limits.MAX_STEP if forward else -limits.MAX_STEP
    for i in range(math.ceil(longest / limits.MAX_STEP)):
        before = gap
        glide(rates, at, step, 1)
        gap, rate, _ = _approach(rates, surface, at, height, radius)
        if not math.isfinite(gap + rate):
            return np.nan
        if (before >= 0.0 and gap < 0.0) if forward else gap >= 0.0:
            return i * step if forward else (i + 1) * step
        if gap < 0.0 and (rate < 0.0) == forward:
            return np.nan
    return np.nan


@machine_code(NOTHING(LAW, LAW, TWO, ONE, ONE, REAL, ONE))
def times_of(rates, surface, start, heights, longest, radius, tau):
    """Times tau (m,) s to the next contacts of m falling balls; NaN where there is none. Arguments as `meet`."""
    near = np.zeros(len(tau))
    for attempt in range(2):  # the second for those that the first does not find
        _search(rates, surface, start, heights, radius, longest, near)
        missing = False
        for r in range(len(tau)):
            if attempt == 0 or math.isnan(tau[r]):
                tau[r] = near[r]
            missing = missing or math.isnan(tau[r])
        if not missing:
            return
        for r in range(len(tau)):
            near[r] = np.nan
            if attempt == 0 and math.isnan(tau[r]):
                near[r] = _scan(only(rates, r), only(surface, r), start[r], heights[r], radius, longest[r])


@machine_code(NOTHING(*GIVEN[:2], TWO, TWO, TWO, ONE, ONE, ONE, ONE, REAL, ONE))
def contact_times(rates, surface, start, c, s, w, ws, heights, longest, radius, tau):
    """`times_of` for Python."""
    none, nones = np.empty((len(c), c.shape[1], 0)), np.empty((len(s), s.shape[1], 0))
    times_of(law_at(rates, c, none, w), law_at(surface, s, nones, ws), start, heights, longest, radius, tau)


@machine_code(NOTHING(LAWS, TWO, THREE, ONE, ONE, REAL, ONE, TWO, TWO, THREE))
def meet(laws, start, startt, heights, longest, radius, tau, taut, after, aftert):
    """The next contacts of m falling balls, near their states (m, 9).

    Args:
        start (m, 9), startt (m, 9, d): states and tangents.
        heights (m,) m, longest (m,) s: of the surfaces, and how far to look.  radius: m, of the ball.
    Writes: time to the contact tau (m,) s and the state after it (m, 9), with tangents; NaN where there is none.
    """
    d, (rates, impact, surface) = startt.shape[2], laws
    x, later, xt, o = np.empty(9), np.empty((9, d + 1)), np.empty((9, d)), np.empty(3)
    moved, ct, st = np.empty((3, d + 1)), np.zeros((rates.c.shape[1], d + 1)), np.zeros((surface.c.shape[1], d + 1))
    by_time = np.zeros(d + 1)  # the last direction is that of the contact's time
    by_time[d] = 1.0
    times_of(rates, surface, start, heights, longest, radius, tau)
    steps = common_steps(tau)
    for r in range(len(start)):
        found = tau[r]
        if math.isnan(found):
            for i in range(9):
                after[r, i] = np.nan
                for q in range(d):
                    aftert[r, i, q], taut[r, q] = 0.0, 0.0
            continue
        put(x, start[r])
        put_all(later, startt[r])
        put_all(ct, rates.ct[r])
        put_all(st, surface.ct[r])
        for i in range(9):
            later[i, d] = 0.0
        fly_one(
            Law(rates.compute, rates.c[r : r + 1], ct.reshape(1, *ct.shape), rates.w), x, later, found, by_time, steps
        )
        evaluate(Law(surface.compute, surface.c[r : r + 1], st.reshape(1, *st.shape), surface.w), x, later, o, moved)
        speed = min(later[2, d] - moved[0, d], -limits.MIN_SPEED)
        for q in range(d):  # at the contact the gap is zero: d gap + d gap / d tau d tau = 0
            taut[r, q] = -(later[2, q] - moved[0, q]) / speed
            for i in range(9):
                xt[i, q] = later[i, q] + later[i, d] * taut[r, q]
        evaluate(only(impact, r), x, xt, after[r], aftert[r])


@machine_code(types.Tuple((TWO, THREE))(ONE, COUNTS, TWO, COUNT))
def coefficients_of(own, places, start, width):
    """Coefficients (m, p) of a function for each ball, and their tangents (m, p, d).

    Args:
        own (p,), places (p,): values, and -1, or in place of the value the column of `start` in which it travels.
        start (m, 9 + q): the balls.  width: d, 9 + q or 0.
    """
    m, p = len(start), len(own)
    c, ct = np.empty((m, p)), np.zeros((m, p, width))
    for r in range(m):
        for k in range(p):
            c[r, k] = own[k] if places[k] < 0 else start[r, places[k]]
            if places[k] >= 0 and width > 0:
                ct[r, k, places[k]] = 1.0
    return c, ct


@machine_code(FLAG(*[ADDRESS] * 3, *[ONE] * 3, *[COUNTS] * 3, *[ONE] * 3, TWO, ONE, TWO, REAL, TWO, THREE, TWO))
def travel(
    rates, impact, surface, own, owni, owns, places, placesi, placess, w, wb, ws,
    start, dt, heights, radius, after, moved, times,
):  # fmt: skip
    """Moves m balls on by durations dt (m,) s, through a contact at each of their surfaces heights (m, k) on the way.

    Args: start (m, 9 + q): states with the coefficients that travel; the others as `coefficients_of` takes them.
    Writes: after (m, 9 + q); its derivatives by `start`, moved (m, 9 + q, d), d either 9 + q or 0; contact times (m, k)
        s since the start. NaN after a contact that never comes.
    Returns: False, without a motion, if a duration is infinite.
    """
    (m, wide), d = start.shape, moved.shape[2]
    c, ct = coefficients_of(own, places, start, d)
    b, bt = coefficients_of(owni, placesi, start, d)
    s, st = coefficients_of(owns, placess, start, d)
    laws = laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws)
    x, xt, y, yt = np.empty((m, 9)), np.zeros((m, 9, d)), np.empty((m, 9)), np.empty((m, 9, d))
    left, earlier, tau, taut = dt.copy(), np.zeros((m, d)), np.empty(m), np.empty((m, d))
    level, longest = np.empty(m), np.empty(m)
    for r in range(m):
        if math.isinf(dt[r]):
            return False
        longest[r] = abs(dt[r]) + limits.BEYOND
        for i in range(9):
            x[r, i] = start[r, i]
            if d > 0:
                xt[r, i, i] = 1.0
    for k in range(heights.shape[1]):
        for r in range(m):
            level[r] = heights[r, k]
        meet(laws, x, xt, level, longest, radius, tau, taut, y, yt)
        for r in range(m):
            times[r, k] = tau[r] + (times[r, k - 1] if k > 0 else 0.0)
            left[r] = dt[r] - times[r, k]
            for q in range(d):
                earlier[r, q] -= taut[r, q]
        x, xt, y, yt = y, yt, x, xt
    fly_together(rates, x, xt, c, ct, w, left, earlier, common_steps(left))
    for r in range(m):
        for i in range(wide):
            after[r, i] = x[r, i] if i < 9 else start[r, i]
            for q in range(d):
                moved[r, i, q] = xt[r, i, q] if i < 9 else (1.0 if q == i else 0.0)
    return True


@machine_code(NOTHING(*GIVEN[:3], TWO, THREE, *GIVEN[3:], ONE, ONE, REAL, ONE, TWO, TWO, THREE))
def contacts(
    rates, impact, surface, start, startt, c, ct, b, bt, s, st, w, wb, ws,
    heights, longest, radius, tau, taut, after, aftert,
):  # fmt: skip
    """`meet` for Python."""
    laws = laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws)
    meet(laws, start, startt, heights, longest, radius, tau, taut, after, aftert)
