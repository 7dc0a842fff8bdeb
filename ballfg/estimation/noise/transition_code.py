"""Multiplies transitions and inverts small roots in machine code, for the filter of linearised tracks.

Of w numbers the first nine are the state; the next, up to d, are coefficients, which stay; the last three, if d < w,
are biases, which decay. So a transition is nine rows of numbers, then ones, then decays on the diagonal.
"""

import math

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FLAG, NOTHING, REAL, TWO
from ballfg.state import STATE_DIM


@machine_code(NOTHING(COUNT, REAL, TWO, TWO))
def _keep(d, decay, x, result):
    """Writes the rows of x (w, w) that only ones and decays act on; zero for those of the state."""
    for i in range(len(x)):
        own = 0.0 if i < STATE_DIM else 1.0 if i < d else decay
        for j in range(len(x)):
            result[i, j] = own * x[i, j]


@machine_code(NOTHING(TWO, REAL, TWO, TWO))
def move(transition, decay, x, result):
    """The product F x of a transition and x (w, w).

    Args: transition (d, d): of state and coefficients.  decay: of biases.
    """
    d, w = len(transition), len(x)
    _keep(d, decay, x, result)
    for i in range(STATE_DIM):
        for s in range(d):
            factor = transition[i, s]
            if factor != 0.0:
                for j in range(w):
                    result[i, j] += factor * x[s, j]


@machine_code(NOTHING(TWO, REAL, TWO, TWO))
def pull(transition, decay, x, result):
    """The product F' x of a transition, as `move` takes it, and x (w, w)."""
    d, w = len(transition), len(x)
    _keep(d, decay, x, result)
    for s in range(STATE_DIM):
        for i in range(d):
            factor = transition[s, i]
            if factor != 0.0:
                for j in range(w):
                    result[i, j] += factor * x[s, j]


@machine_code(NOTHING(TWO, TWO, TWO))
def multiply(x, y, result):
    """The product x y of two matrices (w, w)."""
    for i in range(len(x)):
        for j in range(len(x)):
            result[i, j] = 0.0
        for s in range(len(x)):
            for j in range(len(x)):
                result[i, j] += x[i, s] * y[s, j]


@machine_code(NOTHING(TWO, TWO))
def transpose(x, result):
    """The transpose of x (w, w)."""
    for i in range(len(x)):
        for j in range(len(x)):
            result[i, j] = x[j, i]


@machine_code(FLAG(TWO))
def is_something(covariance):
    """True if a covariance is not zero, by its diagonal."""
    total = 0.0
    for i in range(len(covariance)):
        total += covariance[i, i]
    return total != 0.0


@machine_code(FLAG(TWO, TWO))
def invert_root(x, inverse):
    """Writes the inverse (3, 3) of the Cholesky root of x (3, 3); False if x is not positive definite."""
    root = np.zeros((3, 3))
    inverse[:] = 0.0
    for i in range(3):
        for j in range(i + 1):
            rest = x[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if i != j:
                root[i, j] = rest / root[j, j]
            elif rest > 0.0:
                root[i, i] = math.sqrt(rest)
            else:
                return False
    for i in range(3):
        inverse[i, i] = 1.0 / root[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= root[i, k] * inverse[k, j]
            inverse[i, j] = total / root[i, i]
    return True
