"""Places the whitened rows of factors where the elimination takes them, with those of the first of their states."""

import math

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, INDEX, NOTHING, REAL, THREE, TWO


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
        free: (n + 1,) the next free row of each state; updated.  variables: (m, a).  residual: (m, d) whitened.
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


@machine_code(NOTHING(TWO, COUNT, COUNT, COUNTS, COUNTS, INDEX, COUNT, THREE))
def place_block(
    system: Array, width: int, own: int, rows: Index, firsts: Index, variables: Index, which: int, block: Array
) -> None:
    """Writes the Jacobians of some factors by one of their variables.

    Args:
        system, rows, firsts, variables: as for `place_residuals`; -1 are the coefficients, -2 is what waits behind the
            first `own` of them.
        width: w, numbers of a state.
        which: number of the variable.  block: (m, d, w) or (m, d, p) whitened, per unit of the variable.
    """
    for factor in range(len(rows)):
        state, row = variables[factor, which], rows[factor]
        column = (state - firsts[factor]) * width if state >= 0 else 2 * width + (own if state < -1 else 0)
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
