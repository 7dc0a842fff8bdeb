"""Machine code that carries means and covariances of balls through free flight, step by step.

A step in which a ball comes down on a surface, or rests, is not one of free flight: the code stops before it.
"""

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import fly_one
from ballfg.dynamics.compiled.signatures import COUNT, FOUR, FUNCTION, NOTHING, ONE, REAL, THREE, TWO
from ballfg.dynamics.motion.limits import REST_GAP, REST_SPEED


@machine_code(NOTHING(TWO, TWO, REAL, ONE, TWO))
def _carry_covariance(jacobian, covariance, h, noise, after):
    """J P J^T and what the ball gathers in h s; J (9, d) by the state, the coefficients stay. Writes after (d, d)."""
    d, acceleration, spin = len(covariance), noise[0], noise[1]
    half = covariance.copy()  # J P
    for i in range(9):
        for j in range(d):
            total = 0.0
            for q in range(d):
                total += jacobian[i, q] * covariance[q, j]
            half[i, j] = total
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            if j < 9:
                for q in range(d):
                    total += half[i, q] * jacobian[j, q]
            else:
                total = half[i, j]
            after[i, j] = total
    for i in range(3):
        after[i, i] += acceleration**2 * h**3 / 3.0
        after[3 + i, i] += acceleration**2 * h**2 / 2.0
        after[3 + i, 3 + i] += acceleration**2 * h
        after[6 + i, 6 + i] += spin**2 * h
    for i in range(d):
        for j in range(i):
            after[j, i] = after[i, j]


@machine_code(COUNT(FUNCTION, FUNCTION, TWO, THREE, TWO, THREE, TWO, ONE, ONE, TWO, COUNT, ONE, ONE, THREE, FOUR))
def carry(rates, surface, mean, covariance, c, ct, s, w, ws, h, checked, heights, noise, means, covariances):
    """Carry n balls on by steps of h (n, k) s, as long as the first `checked` of them fly freely.

    Args:
        mean (n, d), covariance (n, d, d): at the start.
        c, s: coefficients of rates and surface, (n, p), those of the rates with tangents ct (n, p, d).
        w, ws: weights of the two.
        checked: how many of the balls meet surfaces; the others fly through them.
        heights (3,) m: of the table, of what lies below it (-inf: nothing), and the ball's radius.
        noise (2,): densities of the process noise, m/s^2/sqrt(Hz) of the acceleration and rad/s/sqrt(s) of the spin.
    Writes: means (k, n, d) and covariances (k, n, d, d) after each step.
    Returns: the number of steps until one in which a ball comes down on a surface or rests.
    """
    n, d = mean.shape
    jacobian, still, x, none = np.empty((9, d)), np.zeros(d), np.empty(9), np.empty((9, 0))
    offset, nothing, nones = np.empty(3), np.empty((3, 0)), np.empty((s.shape[1], 0))
    for k in range(h.shape[1]):
        for r in range(n):
            before = mean[r] if k == 0 else means[k - 1, r]
            x[:] = before[:9]
            jacobian[:] = 0.0
            for i in range(9):
                jacobian[i, i] = 1.0
            level = heights[0] if x[2] > heights[0] else heights[1]
            if r < checked and abs(x[5]) <= REST_SPEED / 2:
                surface(x, s[r], ws, none, nones, offset, nothing)
                if abs(x[2] - level - offset[0] - heights[2]) <= REST_GAP:
                    return k
            fly_one(rates, x, c[r], w, jacobian, ct[r], h[r, k], still, 1)
            if r < checked and not x[5] >= 0.0:
                surface(x, s[r], ws, none, nones, offset, nothing)
                if not x[2] - level - offset[0] - heights[2] >= 0.0:
                    return k
            means[k, r, :9] = x
            means[k, r, 9:] = before[9:]
            held = covariance[r] if k == 0 else covariances[k - 1, r]
            _carry_covariance(jacobian, held, h[r, k], noise, covariances[k, r])
    return h.shape[1]
