"""Eliminates a chain with one further state behind the coefficients, dropped once its columns have faded.

The further state is a section's first one. The rows of the chain's later states depend on it less and less. Where that
dependence falls below the resolution of the arithmetic, its columns are dropped, and the rest of the chain takes less
than half the time.
"""

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, NOTHING, REAL, THREE, TWO
from ballfg.factors.linear.elimination import BLOCK, absorb, copy_kept, padded, reduce_block

FADED = 1e-13
"""Share of the present information on a number, below which a state's further information is dropped."""


@machine_code(REAL(TWO, TWO, COUNT, COUNT, COUNT))
def _strength(carry: Array, shared: Array, width: int, own: int, held: int) -> float:
    """Information of a chain's next state on the further state, relative to that of the states before it."""
    p, most = len(shared), 0.0
    for column in range(2 * width + own, 2 * width + own + held):
        told, known = 0.0, 0.0
        for row in range(width):
            told = max(told, abs(carry[row, column]))
        for row in range(p):
            known = max(known, abs(shared[row, column]))
        if told > most * known:
            most = told / known if known > 0.0 else np.inf
    return most


@machine_code(NOTHING(TWO, COUNTS, COUNT, COUNT, THREE, TWO))
def eliminate_fading(system: Array, start: Index, width: int, held: int, root: Array, last: Array) -> None:
    """Reduces all rows to the triangle R with its right side, as `ballfg.factors.linear.elimination.eliminate` does.

    Args:
        system, start, width, root, last: as for `eliminate`.
        held: number of the last coefficients that fade along the chain.
    """
    n, columns, p = len(start) - 2, system.shape[1], len(last)
    own = p - held
    carries, shared = np.zeros((BLOCK + 1, width, columns)), np.zeros((BLOCK + 1, p, columns))
    first = 0
    while first < n and (first == 0 or _strength(carries[0], shared[0], width, own, held) > FADED):
        end = min(first + BLOCK, n)
        reduce_block(system, start, width, first, end, carries, shared, root)
        first = end
    if first < n:
        _eliminate_rest(system, start, width, first, carries[0], shared[0], own, root)
    absorb(shared[0], system, start[n], start[n + 1], 2 * width, p, np.empty(start[n + 1] - start[n]))
    copy_kept(last, shared[0], last.shape[1] - 1)


@machine_code(NOTHING(TWO, COUNTS, COUNT, COUNT, TWO, TWO, COUNT, THREE))
def _eliminate_rest(
    system: Array, start: Index, width: int, first: int, carry: Array, shared: Array, own: int, root: Array
) -> None:
    """Reduces the rows from a state on, which depend on the first `own` coefficients only.

    Args: system, start, width, root: as above.  first: the state.  carry: the triangle of the states before it.
        shared: triangle of the coefficients; updated to that after the last state.
    """
    n, kept = len(start) - 2, 2 * width + own
    columns = padded(kept + 1)
    rows, begins = np.zeros((start[n] - start[first], columns)), start[first : n + 1] - start[first]
    copy_kept(rows, system[start[first] : start[n]], kept)
    carries, known = np.zeros((BLOCK + 1, width, columns)), np.zeros((BLOCK + 1, own, columns))
    copy_kept(carries[0], carry, kept)
    part = np.empty((n - first, width, kept + 1))
    for k in range(0, n - first, BLOCK):
        reduce_block(rows, begins, width, k, min(k + BLOCK, n - first), carries, known, part)
    root[first:] = 0.0
    for i in range(n - first):
        copy_kept(root[first + i], part[i], kept)
    more = np.zeros((own, system.shape[1]))
    copy_kept(more, known[0], kept)
    absorb(shared, more, 0, own, 2 * width, len(shared), np.empty(own))
