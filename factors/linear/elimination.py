"""Eliminates a chain of states by Householder's QR, in machine code.

Every factor depends on one state or on two neighbours, and perhaps on shared coefficients. Its rows are stored with the
first of its states, in a matrix with the columns (x_i, x_{i+1}, c, 0, b), with zeros up to a multiple of four columns.
State by state these rows are reduced: first x_i is eliminated, against the triangle of the earlier states; the rows
that still contain x_{i+1} become its triangle; the rest depends on the coefficients alone. Normal equations would halve
the digits: a loose prior on a spin beside its tight process noise leaves none of them.
"""

import math

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import put_all
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, INDEX, NOTHING, ONE, REAL, THREE, TWO

FOUR_AT_ONCE = 4
"""Number of values that one instruction multiplies."""
BLOCK = 64
"""Number of states that are reduced in one buffer, which so stays in the processor's cache."""


@machine_code(COUNT(COUNT))
def padded(columns: int) -> int:
    """The next multiple of `FOUR_AT_ONCE`."""
    return -(-columns // FOUR_AT_ONCE) * FOUR_AT_ONCE


@machine_code(COUNT(COUNTS, INDEX, COUNT))
def count_rows(counts: Index, variables: Index, dim: int) -> int:
    """Adds the number of rows of some factors to those of their first states.

    Args: counts: (n + 1,) of each state; last those of coefficients alone.  variables: (m, a).  dim: rows of each
    factor.
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
    """Assigns rows to some factors, and writes the right side.

    Args:
        system: (r, k) rows of all factors, zeros to begin with; whitened, each column per unit of its number.
        free: (n + 1,) the next free row of each state; updated.
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
    """Writes the Jacobians of some factors by one of their variables.

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
    """Adds a damping row for every unknown.

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
    """Reflects rows begin:end of the system into a triangle, until their columns first:first+count are zero.

    Columns before those are not read again. Four columns at a time fill one register of a processor.

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


@machine_code(NOTHING(TWO, TWO, COUNT))
def copy_kept(target: Array, source: Array, kept: int) -> None:
    """Copies the first columns of some rows, and the right side, which is last in both."""
    for i in range(target.shape[0]):
        for j in range(kept):
            target[i, j] = source[i, j]
        target[i, target.shape[1] - 1] = source[i, source.shape[1] - 1]


@machine_code(NOTHING(TWO, COUNTS, COUNT, THREE, THREE, THREE))
def eliminate_on(system: Array, start: Index, width: int, carries: Array, shared: Array, root: Array) -> None:
    """Reduces the rows of a part of the chain, from a state to the last, with the triangles of the earlier states.

    Args:
        system: (r, k) as above; overwritten.  width: w.
        start: (m + 1,) the first row of each of m states, and the end.
        carries: (m + 1, w, k) triangle of the earlier states on the first one; those on the others are written.
        shared: (m + 1, p, k) triangle of the coefficients before the first state; those after each state are written.
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
        copy_kept(root[i], upper, root.shape[2] - 1)
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


@machine_code(NOTHING(TWO, COUNTS, COUNT, COUNT, COUNT, THREE, THREE, THREE))
def reduce_block(
    system: Array, start: Index, width: int, first: int, end: int, carries: Array, shared: Array, root: Array
) -> None:
    """Reduces the rows of the states first to end - 1, at most `BLOCK` of them.

    Args:
        system, start, width, root: as for `eliminate`.
        carries, shared: (`BLOCK` + 1, ..) as for `eliminate_on`; their first entries hold the triangles of the earlier
            states, and then those of these.
    """
    count = end - first
    eliminate_on(system, start[first : end + 1], width, carries[: count + 1], shared[: count + 1], root[first:end])
    put_all(carries[0], carries[count])
    put_all(shared[0], shared[count])


@machine_code(NOTHING(TWO, COUNTS, COUNT, THREE, TWO))
def eliminate(system: Array, start: Index, width: int, root: Array, last: Array) -> None:
    """Reduces all rows to the triangle R with its right side.

    system, start, width: as above, with the rows of the coefficients alone after those of the last state.
        system, start, width: as above, with the rows of the coefficients alone behind those of the last state.
        root: (n, w, 2 w + p + 1), written: as above.
        last: (p, 2 w + p + 1), written: the rows of the coefficients, at the end.
    """
    n, columns, p = len(start) - 2, system.shape[1], len(last)
    carries, shared = np.zeros((BLOCK + 1, width, columns)), np.zeros((BLOCK + 1, p, columns))
    for first in range(0, n, BLOCK):
        reduce_block(system, start, width, first, min(first + BLOCK, n), carries, shared, root)
    absorb(shared[0], system, start[n], start[n + 1], 2 * width, p, np.empty(start[n + 1] - start[n]))
    copy_kept(last, shared[0], last.shape[1] - 1)
