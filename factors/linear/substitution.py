"""Computes steps and covariances from the triangle R of a chain of states, in machine code."""

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, NOTHING, ONE, REAL, THREE, TWO
from ballfg.factors.linear.elimination import ROOT, Root


def solution_of(root: Root) -> tuple[Array, Array]:
    """(n, w) states and (p,) coefficients d of R d = y, in the units of the variables."""
    states, coefficients = root.states[..., -1].copy(), root.coefficients[:, -1].copy()
    substitute_back(root, states, coefficients)
    return states, coefficients


@machine_code(NOTHING(ROOT, TWO, ONE))
def substitute_back(triangle: Root, states: Array, coefficients: Array) -> None:
    """Solve R x = y. Args: states: (n, w) and coefficients: (p,), y, which become x."""
    root, last = triangle.states, triangle.coefficients
    n, w = root.shape[:2]
    p = len(coefficients)
    for j in range(p - 1, -1, -1):
        for k in range(j + 1, p):
            coefficients[j] -= last[j, 2 * w + k] * coefficients[k]
        coefficients[j] /= last[j, 2 * w + j]
    for i in range(n - 1, -1, -1):
        for j in range(w - 1, -1, -1):
            left = states[i, j]
            for k in range(j + 1, w):
                left -= root[i, j, k] * states[i, k]
            if i + 1 < n:
                for k in range(w):
                    left -= root[i, j, w + k] * states[i + 1, k]
            for k in range(p):
                left -= root[i, j, 2 * w + k] * coefficients[k]
            states[i, j] = left / root[i, j, j]


@machine_code(NOTHING(ROOT, TWO, ONE))
def substitute_forward(triangle: Root, states: Array, coefficients: Array) -> None:
    """Solve R^T y = x. Args: states: (n, w) and coefficients: (p,), x, which become y."""
    root, last = triangle.states, triangle.coefficients
    n, w = root.shape[:2]
    p = len(coefficients)
    for i in range(n):
        for j in range(w):
            states[i, j] /= root[i, j, j]
            value = states[i, j]
            for k in range(j + 1, w):
                states[i, k] -= root[i, j, k] * value
            if i + 1 < n:
                for k in range(w):
                    states[i + 1, k] -= root[i, j, w + k] * value
            for k in range(p):
                coefficients[k] -= root[i, j, 2 * w + k] * value
    for j in range(p):
        coefficients[j] /= last[j, 2 * w + j]
        for k in range(j + 1, p):
            coefficients[k] -= last[j, 2 * w + k] * coefficients[j]


@machine_code(NOTHING(TWO, TWO))
def invert(upper: Array, inverse: Array) -> None:
    """The inverse (m, m) of a triangle (m, m), in the inverse of its units."""
    m = len(upper)
    for column in range(m):
        for j in range(m):
            inverse[j, column] = 0.0
        for j in range(column, -1, -1):
            left = 1.0 if j == column else 0.0
            for k in range(j + 1, column + 1):
                left -= upper[j, k] * inverse[k, column]
            inverse[j, column] = left / upper[j, j]


@machine_code(NOTHING(TWO, COUNT, REAL, TWO))
def _part(rows: Array, first: int, scale: float, part: Array) -> None:
    """Copies columns from the first on, scaled, into an array of their own."""
    for a in range(part.shape[0]):
        for b in range(part.shape[1]):
            part[a, b] = scale * rows[a, first + b]


@machine_code(NOTHING(TWO, TWO, TWO))
def _multiply(left: Array, right: Array, product: Array) -> None:
    """The product (a, b) of small (a, m) and (m, b): BLAS is no quicker, and takes the import of scipy.linalg."""
    for i in range(left.shape[0]):
        for j in range(right.shape[1]):
            product[i, j] = 0.0
        for k in range(left.shape[1]):
            for j in range(right.shape[1]):
                product[i, j] += left[i, k] * right[k, j]


@machine_code(NOTHING(TWO, TWO, TWO))
def _multiply_turned(left: Array, right: Array, product: Array) -> None:
    """`_multiply` of (a, m) and the transpose of (b, m)."""
    for i in range(left.shape[0]):
        for j in range(right.shape[0]):
            total = 0.0
            for k in range(left.shape[1]):
                total += left[i, k] * right[j, k]
            product[i, j] = total


@machine_code(NOTHING(ROOT, THREE, THREE, TWO))
def covariances_of(triangle: Root, states: Array, cross: Array, coefficients: Array) -> None:
    """Blocks of (R^T R)^-1, from the last state back to the first.

    p(x_i | y) with y = (x_{i+1}, c) is Gaussian with R_i and the coupling S_i to y; with K_i = -R_i^-1 S_i the
    covariance of x_i follows from that of y.

    Args:
        states: (n, w, w), cross: (n, w, w + p) of each state with the next one and the coefficients, coefficients:
            (p, p); written, in the products of the unknowns' units.
    """
    root, last = triangle.states, triangle.coefficients
    n, w = root.shape[:2]
    p = len(coefficients)
    if p:
        own, shared = np.empty((p, p)), np.empty((p, p))
        _part(last, 2 * w, 1.0, shared)
        invert(shared, own)
        _multiply_turned(own, own, coefficients)
    later, inverse = np.zeros((w + p, w + p)), np.empty((w, w))
    upper, coupling, gain = np.empty((w, w)), np.empty((w, w + p)), np.empty((w, w + p))
    own_part, later_part = np.empty((w, w)), np.empty((w, w))
    for a in range(p):
        for b in range(p):
            later[w + a, w + b] = coefficients[a, b]
    for i in range(n - 1, -1, -1):
        _part(root[i], 0, 1.0, upper)
        _part(root[i], w, -1.0, coupling)
        invert(upper, inverse)
        _multiply(inverse, coupling, gain)
        _multiply(gain, later, cross[i])
        _multiply_turned(inverse, inverse, own_part)
        _multiply_turned(cross[i], gain, later_part)
        for a in range(w):
            for b in range(w):
                states[i, a, b] = later[a, b] = own_part[a, b] + later_part[a, b]
            for b in range(p):
                later[a, w + b] = later[w + b, a] = cross[i, a, w + b]
