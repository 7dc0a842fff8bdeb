"""Elimination of a chain of states by Householder's QR, in machine code.

Every factor looks at one state or at two neighbours, and perhaps at coefficients that all share. Its rows are kept with
the first of its states, in a matrix with the columns (x_i, x_{i+1}, c, 0, b), as many zeros as make their number a
multiple of four. State by state these rows are reduced: first x_i goes, against the triangle that the states before
left; what still looks at x_{i+1} becomes its triangle; the rest is known of the coefficients alone. Normal equations
would halve the digits: a loose prior on a spin beside its tight process noise leaves none of them.
"""

import math

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import put_all
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, INDEX, NOTHING, ONE, REAL, THREE, TWO

FOUR_AT_ONCE = 4
"""Numbers that one instruction multiplies."""


def padded(columns: int) -> int:
    """The next multiple of `FOUR_AT_ONCE`."""
    return -(-columns // FOUR_AT_ONCE) * FOUR_AT_ONCE


@machine_code(COUNT(COUNTS, INDEX, COUNT))
def count_rows(counts: Index, variables: Index, dim: int) -> int:
    """Add the rows of some factors to those of their first states.

    Args: counts: (n + 1,) of each state; last those that look at coefficients alone.  variables: (m, a).  dim: rows of
    each.
    Returns: the number of a factor whose states are not neighbours, or -1.
    """
    n = len(counts) - 1
    for factor in range(len(variables)):
        first, last = n, -1
        for k in range(variables.shape[1]):
            state = variables[factor, k]
            if state >= 0:
                first, last = min(first, state), max(last, state)
        if last > first + 1:
            return factor
        counts[first] += dim
    return -1


@machine_code(NOTHING(TWO, COUNTS, INDEX, TWO, COUNTS, COUNTS))
def place_residuals(system: Array, free: Index, variables: Index, residual: Array, rows: Index, firsts: Index) -> None:
    """Give the rows of some factors their places, and write the right side.

    Args:
        system: (r, k) rows of all factors, zeros to begin with; whitened, each column per unit of its number.
        free: (n + 1,) the next free row of each state, moved on.
        variables: (m, a).  residual: (m, d) whitened.
        rows, firsts: (m,) written: the first row of each factor, and its first state.
    """
    n, end = len(free) - 1, system.shape[1] - 1
    for factor in range(len(variables)):
        first = n
        for k in range(variables.shape[1]):
            if 0 <= variables[factor, k] < first:
                first = variables[factor, k]
        rows[factor], firsts[factor] = free[first], first
        free[first] += residual.shape[1]
        for i in range(residual.shape[1]):
            system[rows[factor] + i, end] = -residual[factor, i]


@machine_code(NOTHING(TWO, COUNT, COUNTS, COUNTS, INDEX, COUNT, THREE))
def place_block(
    system: Array, width: int, rows: Index, firsts: Index, variables: Index, which: int, block: Array
) -> None:
    """Write the Jacobians of some factors by one of their variables.

    Args:
        system, rows, firsts, variables: as for `place_residuals`.  width: w, numbers of a state.
        which: number of the variable.  block: (m, d, w) or (m, d, p) whitened, per unit of the variable.
    """
    for factor in range(len(rows)):
        state, row = variables[factor, which], rows[factor]
        column = 2 * width if state < 0 else (state - firsts[factor]) * width
        for i in range(block.shape[1]):
            for j in range(block.shape[2]):
                system[row + i, column + j] += block[factor, i, j]


@machine_code(NOTHING(TWO, COUNTS, COUNTS, COUNT, REAL, TWO))
def damp(system: Array, start: Index, free: Index, width: int, damping: float, diagonal: Array) -> None:
    """Add a row for every unknown, which holds it back.

    Args:
        system, width, free: as above.  start: (n + 2,) the first row of each state, and the end.
        damping: Marquardt's lambda, relative to the diagonal of J^T J.
        diagonal: (n + 1, w + p) zeros; becomes that diagonal, the coefficients in the last row.
    """
    n, end = len(start) - 2, system.shape[1] - 1
    for i in range(n + 1):
        for row in range(start[i], free[i]):
            for j in range(end):
                if j < width and i < n:
                    diagonal[i, j] += system[row, j] ** 2
                elif width <= j < 2 * width and i + 1 < n:
                    diagonal[i + 1, j - width] += system[row, j] ** 2
                elif j >= 2 * width:
                    diagonal[n, j - 2 * width] += system[row, j] ** 2
    for i in range(n + 1):
        for j in range(width if i < n else diagonal.shape[1] - width):
            system[free[i], j if i < n else 2 * width + j] = math.sqrt(damping * diagonal[i, j])
            free[i] += 1


@machine_code(NOTHING(TWO, TWO, COUNT, COUNT, COUNT, COUNT, ONE))
def absorb(upper: Array, system: Array, begin: int, end: int, first: int, count: int, column: Array) -> None:
    """Reflect rows begin:end of the system into a triangle, until their columns first:first+count are zero.

    Columns up to those are used up, nobody reads them again. Four columns at a time fill one register of a processor.

    Args:
        upper: (count, all columns), triangular from column `first` on.
        system: (r, all columns), whose number `FOUR_AT_ONCE` divides.
        column: (end - begin,) or more, room for a column.
    """
    for j in range(count):
        c = first + j
        tail = 0.0
        for r in range(begin, end):
            f = system[r, c]
            column[r - begin] = f
            tail += f * f
        if tail == 0.0:
            continue
        pivot = upper[j, c]
        norm = math.sqrt(pivot * pivot + tail)
        diagonal = -norm if pivot >= 0.0 else norm
        lead = pivot - diagonal
        scale = -1.0 / (diagonal * lead)
        for k in range((c + 1) // FOUR_AT_ONCE * FOUR_AT_ONCE, system.shape[1], FOUR_AT_ONCE):
            s0, s1, s2, s3 = lead * upper[j, k], lead * upper[j, k + 1], lead * upper[j, k + 2], lead * upper[j, k + 3]
            for r in range(begin, end):
                f = column[r - begin]
                s0 += f * system[r, k]
                s1 += f * system[r, k + 1]
                s2 += f * system[r, k + 2]
                s3 += f * system[r, k + 3]
            s0 = s0 * scale if k > c else 0.0  # columns up to c are done
            s1 = s1 * scale if k + 1 > c else 0.0
            s2 = s2 * scale if k + 2 > c else 0.0
            s3 *= scale
            upper[j, k] -= lead * s0
            upper[j, k + 1] -= lead * s1
            upper[j, k + 2] -= lead * s2
            upper[j, k + 3] -= lead * s3
            for r in range(begin, end):
                f = column[r - begin]
                x0, x1 = system[r, k] - f * s0, system[r, k + 1] - f * s1
                x2, x3 = system[r, k + 2] - f * s2, system[r, k + 3] - f * s3
                system[r, k], system[r, k + 1], system[r, k + 2], system[r, k + 3] = x0, x1, x2, x3
        upper[j, c] = diagonal


@machine_code(NOTHING(TWO, TWO))
def _close(rows: Array, root: Array) -> None:
    """Copy rows without the zeros before the right side."""
    end = root.shape[1] - 1
    for i in range(root.shape[0]):
        for j in range(end):
            root[i, j] = rows[i, j]
        root[i, end] = rows[i, rows.shape[1] - 1]


@machine_code(NOTHING(TWO, COUNTS, COUNT, THREE, THREE, THREE))
def eliminate_on(system: Array, start: Index, width: int, carries: Array, shared: Array, root: Array) -> None:
    """Reduce the rows of a part of the chain, from a state on to the last, after what the states before have left.

    Args:
        system: (r, k) as above; it is used up.  width: w.
        start: (m + 1,) the first row of each of m states, and the end.
        carries: (m + 1, w, k) triangle that the states before leave on the first one; those on the others are written.
        shared: (m + 1, p, k) triangle of the coefficients before the first state; that after each state is written.
        root: (m, w, 2 w + p + 1), written: the rows of R of each state: by itself, by the next one, by the
            coefficients, the right side.
    """
    m, columns, p, most = len(start) - 1, system.shape[1], shared.shape[1], 0
    for i in range(m):
        most = max(most, start[i + 1] - start[i])
    column = np.empty(most)
    upper, carry = np.empty((width, columns)), np.empty((width, columns))
    for i in range(m):
        put_all(upper, carries[i])
        absorb(upper, system, start[i], start[i + 1], 0, width, column)
        _close(upper, root[i])
        for j in range(width):
            for k in range(columns):
                carry[j, k] = 0.0
        absorb(carry, system, start[i], start[i + 1], width, width, column)
        for j in range(width):
            for k in range(width):
                carries[i + 1, j, k], carries[i + 1, j, width + k] = carry[j, width + k], 0.0
            for k in range(2 * width, columns):
                carries[i + 1, j, k] = carry[j, k]
        put_all(shared[i + 1], shared[i])
        absorb(shared[i + 1], system, start[i], start[i + 1], 2 * width, p, column)


@machine_code(NOTHING(TWO, COUNTS, COUNT, THREE, TWO))
def eliminate(system: Array, start: Index, width: int, root: Array, last: Array) -> None:
    """Reduce all rows to the triangle R with its right side.

    Args:
        system, start, width: as above, with the rows of the coefficients alone behind those of the last state.
        root: (n, w, 2 w + p + 1), written: as above.
        last: (p, 2 w + p + 1), written: the rows of the coefficients, at the end.
    """
    n, columns, p = len(start) - 2, system.shape[1], len(last)
    carries, shared = np.zeros((n + 1, width, columns)), np.zeros((n + 1, p, columns))
    eliminate_on(system, start[: n + 1], width, carries, shared, root)
    absorb(shared[n], system, start[n], start[n + 1], 2 * width, p, np.empty(start[n + 1] - start[n]))
    _close(shared[n], last)


@machine_code(NOTHING(THREE, TWO, TWO, ONE))
def substitute_back(root: Array, last: Array, states: Array, coefficients: Array) -> None:
    """Solve R x = y.

    Args: root, last: rows of R as `eliminate` leaves them.  states: (n, w) and coefficients: (p,), y, which become x.
    """
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


@machine_code(NOTHING(THREE, TWO, TWO, ONE))
def substitute_forward(root: Array, last: Array, states: Array, coefficients: Array) -> None:
    """Solve R^T y = x.

    Args: root, last: as above.  states: (n, w) and coefficients: (p,), x, which become y.
    """
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
    """Copy columns from the first on, scaled, into an array of their own."""
    for a in range(part.shape[0]):
        for b in range(part.shape[1]):
            part[a, b] = scale * rows[a, first + b]


@machine_code(NOTHING(THREE, TWO, THREE, THREE, TWO))
def covariances_of(root: Array, last: Array, states: Array, cross: Array, coefficients: Array) -> None:
    """Blocks of (R^T R)^-1, from the last state back to the first.

    p(x_i | y) with y = (x_{i+1}, c) is Gaussian with R_i and the coupling S_i to y; with K_i = -R_i^-1 S_i the
    covariance of x_i follows from that of y.

    Args:
        root, last: as above.
        states: (n, w, w), cross: (n, w, w + p) of each state with the next one and the coefficients, coefficients:
            (p, p); written, in the products of the unknowns' units.
    """
    n, w = root.shape[:2]
    p = len(coefficients)
    if p:
        own, shared = np.empty((p, p)), np.empty((p, p))
        _part(last, 2 * w, 1.0, shared)
        invert(shared, own)
        coefficients[:] = np.dot(own, own.T)
    later, inverse = np.zeros((w + p, w + p)), np.empty((w, w))
    upper, coupling = np.empty((w, w)), np.empty((w, w + p))
    for a in range(p):
        for b in range(p):
            later[w + a, w + b] = coefficients[a, b]
    for i in range(n - 1, -1, -1):
        _part(root[i], 0, 1.0, upper)
        _part(root[i], w, -1.0, coupling)
        invert(upper, inverse)
        gain = np.dot(inverse, coupling)
        put_all(cross[i], np.dot(gain, later))
        own_part, later_part = np.dot(inverse, inverse.T), np.dot(cross[i], gain.T)
        for a in range(w):
            for b in range(w):
                states[i, a, b] = later[a, b] = own_part[a, b] + later_part[a, b]
            for b in range(p):
                later[a, w + b] = later[w + b, a] = cross[i, a, w + b]
