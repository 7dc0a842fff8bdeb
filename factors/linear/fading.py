"""Elimination of a chain behind whose coefficients another state waits that only the beginning of the chain tells of.

The first state of a section, say. The rows of the chain's later states mean less and less to it. Where what they still
mean has faded below what the arithmetic resolves, its columns are dropped, and the rest of the chain is reduced in less
than half the time.
"""

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, NOTHING, REAL, THREE, TWO
from ballfg.factors.linear.elimination import BLOCK, absorb, copy_kept, padded, reduce_block

FADED = 1e-13
"""Share of what is known of a number already, below which what a state still tells of it is dropped."""


@machine_code(REAL(TWO, TWO, COUNT, COUNT, COUNT))
def _strength(carry: Array, shared: Array, width: int, own: int, held: int) -> float:
    """How much a chain's next state tells of what waits, compared with what the states before it told."""
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
    """Reduce all rows to the triangle R with its right side, as `ballfg.factors.linear.elimination.eliminate` does.

    Args:
        system, start, width, root, last: as for it.
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
    """Reduce the rows from a state on, which say nothing of the coefficients but the first `own`.

    Args: system, start, width, root: as above.  first: the state.  carry: what the states before it left.
        shared: of the coefficients; becomes that after the last state.
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
