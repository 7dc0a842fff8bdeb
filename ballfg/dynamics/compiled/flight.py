"""Moves balls in free flight in machine code, by a model's compiled rates.

Each row of a batch is a ball with coefficients of its own; weights w are the same for all. Tangents travel with the
values: derivatives in d directions at once, of which there may be none. The rules are those of
`ballfg.dynamics.motion`, which torch code follows.
"""

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FOUR, FUNCTION, NOTHING, ONE, REAL, THREE, TWO

TOGETHER = 96
"""Number of balls whose network layers fit into a processor's cache."""


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


@machine_code(NOTHING(FUNCTION, ONE, ONE, ONE, TWO, TWO, ONE, TWO))
def evaluate(function, x, c, w, xt, ct, y, yt):
    """A model's function of one state x (9,) with coefficients c (p,): y (m,); tangents (9, d), (p, d), (m, d)."""
    p, m, d = len(c), len(y), xt.shape[1]
    one, moved = (x.reshape(1, 9), c.reshape(1, p)), (xt.reshape(1, 9, d), ct.reshape(1, p, d))
    function(one[0], one[1], w, moved[0], moved[1], y.reshape(1, m), yt.reshape(1, m, d))


@machine_code(NOTHING(FUNCTION, ONE, ONE, ONE, TWO, TWO, ONE, TWO, ONE, TWO))
def slope_at(rates, x, c, w, xt, ct, k, kt, a, at):
    """The derivative k (9,) of a state by time, with tangents; a (6,) and at (6, d) are working memory."""
    evaluate(rates, x, c, w, xt, ct, a, at)
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
    for i in range(9):
        total[i] = k[i] = k1[i]
        for q in range(d):
            totalt[i, q] = kt[i, q] = k1t[i, q]
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
        put(nodes[r, 0], start[r])
        put_all(nodest[r, 0], startt[r])
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


@machine_code(NOTHING(FUNCTION, TWO, TWO, ONE, THREE, THREE, TWO, THREE, TWO, THREE))
def slopes_at(rates, x, c, w, xt, ct, k, kt, a, at):
    """As `slope_at`, of the rows of x (m, 9)."""
    rates(x, c, w, xt, ct, a, at)
    for r in range(len(x)):
        for i in range(3):
            k[r, i], k[r, 3 + i], k[r, 6 + i] = x[r, 3 + i], a[r, i], a[r, 3 + i]
            for q in range(xt.shape[2]):
                kt[r, i, q], kt[r, 3 + i, q], kt[r, 6 + i, q] = xt[r, 3 + i, q], at[r, i, q], at[r, 3 + i, q]


@machine_code(NOTHING(FUNCTION, TWO, TWO, ONE, THREE, THREE, ONE, TWO, COUNT))
def fly_side_by_side(rates, x, c, w, xt, ct, duration, durationt, steps):
    """As `fly_one`, of the rows of x (m, 9), whose rates are computed together."""
    n, d = len(x), xt.shape[2]
    k, kt, a, at = np.empty((n, 9)), np.empty((n, 9, d)), np.empty((n, 6)), np.empty((n, 6, d))
    x2, x2t, total, totalt = np.empty((n, 9)), np.empty((n, 9, d)), np.empty((n, 9)), np.empty((n, 9, d))
    for _ in range(steps):
        slopes_at(rates, x, c, w, xt, ct, k, kt, a, at)
        put_all(total, k)
        put_all(totalt.reshape(n * 9, d), kt.reshape(n * 9, d))
        for stage in range(3):
            share, weight = (1.0 if stage == 2 else 0.5), (1.0 if stage == 2 else 2.0)
            for r in range(n):
                h = duration[r] / steps
                for i in range(9):
                    x2[r, i] = x[r, i] + share * h * k[r, i]
                    for q in range(d):
                        x2t[r, i, q] = xt[r, i, q] + share * (h * kt[r, i, q] + durationt[r, q] / steps * k[r, i])
            slopes_at(rates, x2, c, w, x2t, ct, k, kt, a, at)
            for r in range(n):
                for i in range(9):
                    total[r, i] += weight * k[r, i]
                    for q in range(d):
                        totalt[r, i, q] += weight * kt[r, i, q]
        for r in range(n):
            h = duration[r] / steps
            for i in range(9):
                x[r, i] += h / 6.0 * total[r, i]
                for q in range(d):
                    xt[r, i, q] += (h * totalt[r, i, q] + durationt[r, q] / steps * total[r, i]) / 6.0


@machine_code(NOTHING(FUNCTION, TWO, THREE, TWO, THREE, ONE, ONE, TWO, COUNT))
def fly_together(rates, state, statet, c, ct, w, dt, dtt, steps):
    """Move m balls on by durations dt (m,) s with tangents dtt (m, d), in so many equal steps each, in place."""
    for first in range(0, len(state), TOGETHER):
        past = min(first + TOGETHER, len(state))
        x, xt, own, ownt = state[first:past], statet[first:past], c[first:past], ct[first:past]
        fly_side_by_side(rates, x, own, w, xt, ownt, dt[first:past], dtt[first:past], steps)
