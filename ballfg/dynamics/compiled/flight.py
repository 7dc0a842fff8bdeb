"""Machine code that moves balls in free flight, round a model's compiled rates.

Each row of a batch is a ball with coefficients of its own; weights w are the same for all. Tangents travel with the
values: derivatives in d directions at once, of which there may be none. The rules are those of
`ballfg.dynamics.motion`, which torch code follows.
"""

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FOUR, FUNCTION, NOTHING, ONE, REAL, THREE, TWO


@machine_code(NOTHING(FUNCTION, ONE, ONE, ONE, TWO, TWO, ONE, TWO, ONE, TWO))
def slope_at(rates, x, c, w, xt, ct, k, kt, a, at):
    """The derivative k (9,) of a state by time, with tangents; a (6,) and at (6, d) are working memory."""
    rates(x, c, w, xt, ct, a, at)
    for i in range(3):
        k[i] = x[3 + i]
        for q in range(xt.shape[1]):
            kt[i, q] = xt[3 + i, q]
    for i in range(6):
        k[3 + i] = a[i]
        for q in range(xt.shape[1]):
            kt[3 + i, q] = at[i, q]


@machine_code(NOTHING(FUNCTION, ONE, ONE, ONE, TWO, TWO, REAL, ONE, ONE, TWO, ONE, TWO))
def step_on(rates, x, c, w, xt, ct, h, ht, k1, k1t, y, yt):
    """One Runge-Kutta step of h s from x with the slope k1 there, to y; all with tangents (ht (d,)). y may be x."""
    d = xt.shape[1]
    x2, x2t, total, totalt = np.empty(9), np.empty((9, d)), np.empty(9), np.empty((9, d))
    k, kt, a, at = np.empty(9), np.empty((9, d)), np.empty(6), np.empty((6, d))
    total[:] = k1
    totalt[:] = k1t
    k[:] = k1
    kt[:] = k1t
    for stage in range(3):
        share = 1.0 if stage == 2 else 0.5
        for i in range(9):
            x2[i] = x[i] + share * h * k[i]
            for q in range(d):
                x2t[i, q] = xt[i, q] + share * (h * kt[i, q] + ht[q] * k[i])
        slope_at(rates, x2, c, w, x2t, ct, k, kt, a, at)
        weight = 1.0 if stage == 2 else 2.0
        for i in range(9):
            total[i] += weight * k[i]
            for q in range(d):
                totalt[i, q] += weight * kt[i, q]
    for i in range(9):
        y[i] = x[i] + h / 6.0 * total[i]
        for q in range(d):
            yt[i, q] = xt[i, q] + (h * totalt[i, q] + ht[q] * total[i]) / 6.0


@machine_code(NOTHING(FUNCTION, TWO, THREE, TWO, THREE, ONE, ONE, COUNT, THREE, FOUR, THREE, FOUR))
def fly_arcs(rates, start, startt, c, ct, w, step, count, nodes, nodest, slopes, slopest):
    """Flight of m balls over `count` steps of their own length.

    Args: start (m, 9), startt (m, 9, d), c (m, p), ct (m, p, d), step (m,) s.
    Writes: states nodes (m, count + 1, 9) and their derivatives by time, slopes, with tangents (m, count + 1, 9, d).
    """
    a, at, still = np.empty(6), np.empty((6, startt.shape[2])), np.zeros(startt.shape[2])
    for r in range(len(start)):
        nodes[r, 0] = start[r]
        nodest[r, 0] = startt[r]
        slope_at(rates, nodes[r, 0], c[r], w, nodest[r, 0], ct[r], slopes[r, 0], slopest[r, 0], a, at)
        for s in range(count):
            x, xt, y, yt = nodes[r, s], nodest[r, s], nodes[r, s + 1], nodest[r, s + 1]
            step_on(rates, x, c[r], w, xt, ct[r], step[r], still, slopes[r, s], slopest[r, s], y, yt)
            slope_at(rates, y, c[r], w, yt, ct[r], slopes[r, s + 1], slopest[r, s + 1], a, at)


@machine_code(NOTHING(FUNCTION, ONE, ONE, ONE, TWO, TWO, REAL, ONE, COUNT))
def fly_one(rates, x, c, w, xt, ct, duration, durationt, steps):
    """Move a state on by a duration (s, may be negative; tangents (d,)), in so many equal steps; with tangents."""
    d = xt.shape[1]
    k, kt, a, at = np.empty(9), np.empty((9, d)), np.empty(6), np.empty((6, d))
    for _ in range(steps):
        slope_at(rates, x, c, w, xt, ct, k, kt, a, at)
        step_on(rates, x, c, w, xt, ct, duration / steps, durationt / steps, k, kt, x, xt)


@machine_code(NOTHING(FUNCTION, TWO, THREE, TWO, THREE, ONE, ONE, TWO, COUNT))
def fly_rows(rates, state, statet, c, ct, w, dt, dtt, steps):
    """Move m balls on by durations dt (m,) s with tangents dtt (m, d), in so many equal steps each, in place."""
    for r in range(len(state)):
        fly_one(rates, state[r], c[r], w, statet[r], ct[r], dt[r], dtt[r], steps)
