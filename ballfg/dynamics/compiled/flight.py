"""Moves balls in free flight in machine code, by a model's compiled rates.

Each row of a batch is a ball with coefficients of its own; weights w are the same for all. Tangents travel with the
values: derivatives in d directions at once, of which there may be none. The rules are those of
`ballfg.dynamics.motion`, which torch code follows.
"""

import numpy as np
from numba.extending import register_jitable

from ballfg.dynamics.compiled.build import function_at, machine_code
from ballfg.dynamics.compiled.signatures import ADDRESS, COUNT, FOUR, LAW, NOTHING, ONE, REAL, THREE, TWO, Law, Laws
from ballfg.dynamics.motion.limits import STAGES

TOGETHER = 96  # Number of balls whose network layers fit into a processor's cache


@register_jitable
def white_acceleration(dt, density):
    """What white acceleration noise gathers over dt s along an axis: the only place that says so.

    Args: dt: s, a number or an array.  density: m^2/s^3, the square of one in m/s^2/sqrt(Hz).
    Returns: variance of the position (m^2), covariance with the velocity (m^2/s), variance of the velocity (m^2/s^2).
    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
        section 6.2.2 (continuous white noise acceleration model).
    """
    return density * dt**3 / 3.0, density * dt**2 / 2.0, density * dt


@machine_code(NOTHING(ONE, ONE))
def put(target, source):
    """Copy numbers (m,); numba's own copy of an array takes a second to compile wherever it is used."""
    for i in range(len(source)):
        target[i] = source[i]


@machine_code(NOTHING(TWO, TWO))
def put_all(target, source):
    """Copy numbers (m, d)."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@register_jitable
def law_at(address, c, ct, w):
    """A law whose function lies at an address."""
    return Law(function_at(address), c, ct, w)


@register_jitable
def laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws):
    """The `Laws` from arguments as in `signatures.GIVEN`."""
    return Laws(law_at(rates, c, ct, w), law_at(impact, b, bt, wb), law_at(surface, s, st, ws))


@register_jitable
def only(law, r):
    """A law of ball r alone."""
    return Law(law.compute, law.c[r : r + 1], law.ct[r : r + 1], law.w)


@register_jitable
def laws_of_one(laws, r):
    """The laws of ball r alone."""
    return Laws(only(laws.rates, r), only(laws.impact, r), only(laws.surface, r))


@register_jitable
def still(law):
    """A law without tangents."""
    return Law(law.compute, law.c, np.empty((law.c.shape[0], law.c.shape[1], 0)), law.w)


@machine_code(NOTHING(LAW, ONE, TWO, ONE, TWO), makes_arrays=False)
def evaluate(law, x, xt, y, yt):
    """A law of one ball at a state x (9,) with tangents (9, d): writes y (m,) and yt (m, d)."""
    m, d = len(y), xt.shape[1]
    law.compute(x.reshape(1, 9), law.c, law.w, xt.reshape(1, 9, d), law.ct, y.reshape(1, m), yt.reshape(1, m, d))


@machine_code(NOTHING(LAW, ONE, ONE))
def value_of(law, x, y):
    """`evaluate` without tangents; those of the coefficients are not looked at, as there are none of the state."""
    none = np.empty((1, 9, 0))
    law.compute(x.reshape(1, 9), law.c, law.w, none, law.ct, y.reshape(1, len(y)), none)


@machine_code(NOTHING(LAW, TWO, THREE, TWO, THREE, TWO, THREE), makes_arrays=False)
def slopes_at(rates, x, xt, k, kt, a, at):
    """The derivatives k (n, 9) of states by time, with tangents; a (n, 6) and at (n, 6, d) are working memory."""
    d = xt.shape[2]
    rates.compute(x, rates.c, rates.w, xt, rates.ct, a, at)
    for r in range(len(x)):
        for i in range(3):
            k[r, i], k[r, 3 + i], k[r, 6 + i] = x[r, 3 + i], a[r, i], a[r, 3 + i]
            if d:  # else a look at three empty rows takes longer than all the rest
                for q in range(d):
                    kt[r, i, q], kt[r, 3 + i, q], kt[r, 6 + i, q] = xt[r, 3 + i, q], at[r, i, q], at[r, 3 + i, q]


@machine_code(NOTHING(TWO, THREE, TWO, THREE, REAL, ONE, TWO, TWO, THREE))
def _carry_on(after, aftert, x, xt, share, h, ht, k, kt):
    """Write the states after a share of h (n,) s by slopes k (n, 9), with tangents."""
    n, d = len(x), xt.shape[2]
    for r in range(n):
        for i in range(9):
            after[r, i] = x[r, i] + share * h[r] * k[r, i]
            if d:
                for q in range(d):
                    aftert[r, i, q] = xt[r, i, q] + share * (h[r] * kt[r, i, q] + ht[r, q] * k[r, i])


@machine_code(NOTHING(LAW, TWO, THREE, ONE, TWO, TWO, THREE, TWO, THREE))
def step_on(rates, x, xt, h, ht, k, kt, a, at):
    """`flight_step.runge_kutta` of n states, in place: h (n,) s, ht (n, d); a, at: as in `slopes_at`.

    Args: k, kt: the slopes at x, then used up.
    """
    n, d = len(x), xt.shape[2]
    values, moved = np.empty((2, n, 9)), np.empty((2, n, 9, d))
    stage, total, staget, totalt = values[0], values[1], moved[0], moved[1]
    put_all(total, k)
    if d:
        put_all(totalt.reshape(n * 9, d), kt.reshape(n * 9, d))
    for reach, weight in STAGES:
        _carry_on(stage, staget, x, xt, reach, h, ht, k, kt)
        slopes_at(rates, stage, staget, k, kt, a, at)
        for r in range(n):
            for i in range(9):
                total[r, i] += weight * k[r, i]
                if d:
                    for q in range(d):
                        totalt[r, i, q] += weight * kt[r, i, q]
    _carry_on(x, xt, x, xt, 1.0 / 6.0, h, ht, total, totalt)


@machine_code(NOTHING(ADDRESS, TWO, THREE, TWO, THREE, ONE, ONE, COUNT, THREE, FOUR, THREE, FOUR))
def fly_arcs(rates, start, startt, c, ct, w, step, count, nodes, nodest, slopes, slopest):
    """Flight of m balls over `count` steps of their own length.

    Args: start (m, 9), startt (m, 9, d), c (m, p), ct (m, p, d), step (m,) s.
    Writes: states nodes (m, count + 1, 9) and their derivatives by time, slopes, with tangents (m, count + 1, 9, d).
    """
    d = startt.shape[2]
    x, xt, k, kt = np.empty((1, 9)), np.empty((1, 9, d)), np.empty((1, 9)), np.empty((1, 9, d))
    a, at, fixed, law = np.empty((1, 6)), np.empty((1, 6, d)), np.zeros((1, d)), law_at(rates, c, ct, w)
    for r in range(len(start)):
        own = only(law, r)
        put(x[0], start[r])
        put_all(xt[0], startt[r])
        for s in range(count + 1):
            if s:
                step_on(own, x, xt, step[r : r + 1], fixed, k, kt, a, at)
            slopes_at(own, x, xt, k, kt, a, at)
            put(nodes[r, s], x[0])
            put_all(nodest[r, s], xt[0])
            put(slopes[r, s], k[0])
            put_all(slopest[r, s], kt[0])


@machine_code(NOTHING(ADDRESS, TWO, THREE, TWO, THREE, ONE, ONE, TWO, COUNT))
def fly_together(rates, state, statet, c, ct, w, dt, dtt, steps):
    """Move m balls on by durations dt (m,) s with tangents dtt (m, d), in so many equal steps each, in place.

    Durations may be negative. The rates of some balls are computed together.
    """
    for first in range(0, len(state), TOGETHER):
        past = min(first + TOGETHER, len(state))
        x, xt, own = state[first:past], statet[first:past], law_at(rates, c[first:past], ct[first:past], w)
        n, d = len(x), xt.shape[2]
        h, ht = dt[first:past] / steps, dtt[first:past] / steps
        k, kt, a, at = np.empty((n, 9)), np.empty((n, 9, d)), np.empty((n, 6)), np.empty((n, 6, d))
        for _ in range(steps):
            slopes_at(own, x, xt, k, kt, a, at)
            step_on(own, x, xt, h, ht, k, kt, a, at)


@machine_code(NOTHING(LAW, ONE, TWO, REAL, ONE, COUNT))
def fly_one(rates, x, xt, duration, durationt, steps):
    """`fly_together` of one ball: x (9,), tangents (9, d) and (d,)."""
    d = xt.shape[1]
    one, moved = x.reshape(1, 9), xt.reshape(1, 9, d)
    k, kt, a, at = np.empty((1, 9)), np.empty((1, 9, d)), np.empty((1, 6)), np.empty((1, 6, d))
    h, ht = np.empty(1), np.empty((1, d))
    h[0] = duration / steps
    for q in range(d):
        ht[0, q] = durationt[q] / steps
    for _ in range(steps):
        slopes_at(rates, one, moved, k, kt, a, at)
        step_on(rates, one, moved, h, ht, k, kt, a, at)


@machine_code(NOTHING(LAW, ONE, REAL, COUNT))
def glide(rates, x, duration, steps):
    """`fly_one` without tangents."""
    fly_one(still(rates), x, np.empty((9, 0)), duration, np.empty(0), steps)
