"""Interpolates the states of balls between the integration nodes, in machine code."""

import math

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, FLAG, FOUR, NOTHING, ONE, REAL, THREE, TWO


@machine_code(NOTHING(REAL, REAL, TWO, TWO))
def _weights(t, h, w, dw):
    """Weights of a step's ends in the state at theta = t, as `paths.hermite`, and their derivatives by theta.

    Rows: position, velocity, spin. Columns: x0, x1, their derivatives d0, d1, and of these again (accelerations).
    """
    t2, t3, t4 = t * t, t * t * t, t * t * t * t
    t5 = t3 * t2
    rise, steep = 10 * t3 - 15 * t4 + 6 * t5, 30 * t2 - 60 * t3 + 30 * t4
    bend = 60 * t - 180 * t2 + 120 * t3
    w[0, 0], w[0, 1], dw[0, 0], dw[0, 1] = 1 - rise, rise, -steep, steep
    w[0, 2], dw[0, 2] = h * (t - 6 * t3 + 8 * t4 - 3 * t5), h * (1 - 18 * t2 + 32 * t3 - 15 * t4)
    w[0, 3], dw[0, 3] = h * (-4 * t3 + 7 * t4 - 3 * t5), h * (-12 * t2 + 28 * t3 - 15 * t4)
    w[0, 4], dw[0, 4] = h * h * 0.5 * (t2 - 3 * t3 + 3 * t4 - t5), h * h * 0.5 * (2 * t - 9 * t2 + 12 * t3 - 5 * t4)
    w[0, 5], dw[0, 5] = h * h * 0.5 * (t3 - 2 * t4 + t5), h * h * 0.5 * (3 * t2 - 8 * t3 + 5 * t4)
    w[1, 0], w[1, 1], dw[1, 0], dw[1, 1] = -steep / h, steep / h, -bend / h, bend / h
    w[1, 2], dw[1, 2] = 1 - 18 * t2 + 32 * t3 - 15 * t4, -36 * t + 96 * t2 - 60 * t3
    w[1, 3], dw[1, 3] = -12 * t2 + 28 * t3 - 15 * t4, -24 * t + 84 * t2 - 60 * t3
    w[1, 4], dw[1, 4] = h * 0.5 * (2 * t - 9 * t2 + 12 * t3 - 5 * t4), h * 0.5 * (2 - 18 * t + 36 * t2 - 20 * t3)
    w[1, 5], dw[1, 5] = h * 0.5 * (3 * t2 - 8 * t3 + 5 * t4), h * 0.5 * (6 * t - 24 * t2 + 20 * t3)
    w[2, 0], w[2, 1] = 1 - 3 * t2 + 2 * t3, 3 * t2 - 2 * t3
    dw[2, 0], dw[2, 1] = -6 * t + 6 * t2, 6 * t - 6 * t2
    w[2, 2], dw[2, 2] = h * (t - 2 * t2 + t3), h * (1 - 4 * t + 3 * t2)
    w[2, 3], dw[2, 3] = h * (t3 - t2), h * (3 * t2 - 2 * t)
    w[2, 4], w[2, 5], dw[2, 4], dw[2, 5] = 0.0, 0.0, 0.0, 0.0


@machine_code(NOTHING(FLAG, TWO, THREE, COUNTS, ONE, TWO, ONE, THREE, THREE, FOUR, FOUR, COUNT, THREE, FOUR))
def sample(first, times, timest, rows, begun, began, step, nodes, slopes, nodest, slopest, parts, value, tangent):
    """States of the balls of an arc, with tangents, at those of their times that lie in the arc.

    Args:
        first: whether the arc begins the motion, so that all times lie in it.
        times (n, k) s with tangents timest (n, k, d), or (n, k, 0) where they do not move.
        rows (m,): numbers of the arc's balls among all n.
        begun (m,) s, began (m, d), step (m,) s, nodes and slopes (m, j, 9), with tangents (m, j, 9, d): the arc.
        parts: 1 for positions alone, 3 for velocities and spins too.
    Writes: value (n, k, 9) and tangent (n, k, 9, d); (n, k, 3) and (n, k, 3, d) where there is 1 part.
    """
    w, dw, d = np.empty((3, 6)), np.empty((3, 6)), tangent.shape[3]
    moving = timest.shape[2] > 0
    for m in range(len(rows)):
        r = rows[m]
        for k in range(times.shape[1]):
            if not (first or times[r, k] >= begun[m]):
                continue
            place = (times[r, k] - begun[m]) / step[m]
            at = min(max(math.floor(place), 0), nodes.shape[1] - 2) if math.isfinite(place) else 0
            _weights(place - at, step[m], w, dw)
            for part in range(parts):
                for axis in range(3):
                    i = 3 * part + axis
                    own = i if part == 2 else axis  # positions and velocities are made of positions and their slopes
                    x0, x1 = nodes[m, at, own], nodes[m, at + 1, own]
                    d0, d1 = slopes[m, at, own], slopes[m, at + 1, own]
                    a0 = slopes[m, at, 3 + axis]
                    a1 = slopes[m, at + 1, 3 + axis]
                    g, e = w[part], dw[part]
                    value[r, k, i] = g[0] * x0 + g[1] * x1 + g[2] * d0 + g[3] * d1 + g[4] * a0 + g[5] * a1
                    rate = (e[0] * x0 + e[1] * x1 + e[2] * d0 + e[3] * d1 + e[4] * a0 + e[5] * a1) / step[m]
                    x0t, x1t = nodest[m, at, own], nodest[m, at + 1, own]
                    d0t, d1t = slopest[m, at, own], slopest[m, at + 1, own]
                    a0t, a1t = slopest[m, at, 3 + axis], slopest[m, at + 1, 3 + axis]
                    for q in range(d):
                        moved = g[0] * x0t[q] + g[1] * x1t[q] + g[2] * d0t[q] + g[3] * d1t[q]
                        moved += g[4] * a0t[q] + g[5] * a1t[q] - rate * began[m, q]
                        tangent[r, k, i, q] = moved + rate * timest[r, k, q] if moving else moved
