"""Elimination of a chain of states by Householder's QR, in machine code: the package's only one.

Every factor looks at one state or at two neighbours, and perhaps at coefficients that all share. Its rows are kept with
the first of its states, in a matrix with the columns (x_i, x_{i+1}, c, 0, b), as many zeros as make their number a
multiple of four. State by state these rows are reduced: first x_i goes, against the triangle that the states before
left; what still looks at x_{i+1} becomes its triangle; the rest is known of the coefficients alone. Normal equations
would halve the digits: a loose prior on a spin beside its tight process noise leaves none of them.

`eliminate` reduces a whole chain, `eliminate_on` the end of one, after what the states before have left,
`eliminate_each` states that nothing links. All of them are made of `absorb`.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numba import types

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import put_all
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, NOTHING, ONE, REAL, THREE, TWO
from ballfg.factors.linear.four_at_once import FOUR_AT_ONCE, behind, load, minus, padded, plus, store, times

BLOCK = 64
"""States that are reduced with one room for what they leave to each other, which so stays near the processor."""
FADED = 1e-13
"""Share of what is known of a number already, below which what a state still tells of it is dropped."""


class Root(NamedTuple):
    """The triangle R of a chain of n states, R^T R = J^T J, and the right side y of R d = y.

    Attributes:
        states: (n, w, 2 w + p + 1), of each state: its own triangle, the block that couples it to the next state, that
            to the coefficients, y. Each per unit of its variable.
        coefficients: (p, 2 w + p + 1), the same of the coefficients; the first 2 w columns are empty.
    """

    states: Array
    coefficients: Array

    @classmethod
    def empty(cls, states: int, width: int, coefficients: int) -> "Root":
        """Room for the triangle of some states of w numbers, with p coefficients."""
        columns = 2 * width + coefficients + 1
        return cls(np.empty((states, width, columns)), np.empty((coefficients, columns)))

    @property
    def width(self) -> int:
        """Numbers w of a state, biases among them."""
        return self.states.shape[1]

    @property
    def log_determinant(self) -> float:
        """Logarithm of det R, dimensionless."""
        w, p = self.width, len(self.coefficients)
        own = np.diagonal(self.states[:, :, :w], axis1=1, axis2=2)
        shared = np.diagonal(self.coefficients[:, 2 * w : 2 * w + p])
        return float(np.log(np.abs(own)).sum() + np.log(np.abs(shared)).sum())


ROOT: Final[Any] = types.NamedTuple((THREE, TWO), Root)


@machine_code(NOTHING(TWO, TWO, COUNT, COUNT, COUNT, COUNT, ONE))
def absorb(upper: Array, system: Array, begin: int, end: int, first: int, count: int, column: Array) -> None:
    """Reflects rows begin:end of the system into a triangle, until their columns first:first+count are zero.

    Columns before those are not read again.

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
            above = load(upper, j, k)
            shares = times(lead, above)
            for r in range(begin, end):
                shares = plus(shares, times(column[r - begin], load(system, r, k)))
            shares = behind(c, k, times(scale, shares))  # columns up to c are done
            store(upper, j, k, minus(above, times(lead, shares)))
            for r in range(begin, end):
                store(system, r, k, minus(load(system, r, k), times(column[r - begin], shares)))
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
        copy_kept(root[i], upper, 2 * width + p)
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


@machine_code(NOTHING(THREE, THREE))
def eliminate_each(systems: Array, upper: Array) -> None:
    """Reduce the rows of states that nothing links, each by itself; what is left of the rows tells nothing of it.

    Args:
        systems: (n, r, k) rows of n states, the w columns of the state first; `FOUR_AT_ONCE` divides k.
        upper: (n, w, k) triangle that is known of each beforehand; becomes that with its rows.
    """
    column = np.empty(systems.shape[1])
    for i in range(len(systems)):
        absorb(upper[i], systems[i], 0, systems.shape[1], 0, upper.shape[1], column)


@machine_code(REAL(TWO, TWO, COUNT, COUNT))
def _told(carry: Array, shared: Array, first: int, count: int) -> float:
    """How much a chain's next state tells of some columns, compared with what the states before it told."""
    most = 0.0
    for column in range(first, first + count):
        told, known = 0.0, 0.0
        for row in range(len(carry)):
            told = max(told, abs(carry[row, column]))
        for row in range(len(shared)):
            known = max(known, abs(shared[row, column]))
        if told > most * known:
            most = told / known if known > 0.0 else np.inf
    return most


@machine_code(COUNT(TWO, COUNTS, COUNT, COUNT, THREE, THREE, THREE))
def _reduce(system: Array, start: Index, width: int, held: int, carries: Array, shared: Array, root: Array) -> int:
    """Reduce states in blocks, to the last or until the next one tells nothing of the last `held` coefficients.

    Args:
        system, start, width, root: as for `eliminate_on`.  held: 0 to go on to the last.
        carries, shared: (`BLOCK` + 1, ..) as for it; their first entries are what the states before have left, and
            become what these leave.
    Returns: the state that is next.
    """
    n, first, waiting = len(root), 0, 2 * width + shared.shape[1] - held
    while first < n and not (held and first and _told(carries[0], shared[0], waiting, held) <= FADED):
        count = min(BLOCK, n - first)
        part = start[first : first + count + 1]
        eliminate_on(system, part, width, carries[: count + 1], shared[: count + 1], root[first : first + count])
        put_all(carries[0], carries[count])
        put_all(shared[0], shared[count])
        first += count
    return first


@machine_code(NOTHING(TWO, COUNTS, COUNT, COUNT, ROOT))
def eliminate(system: Array, start: Index, width: int, held: int, root: Root) -> None:
    """Reduce all rows to the triangle R with its right side.

    Behind the coefficients another state may wait that only the beginning of the chain tells of, such as the first one
    of a section. Where what the chain still tells of it has faded below what the arithmetic resolves, its columns are
    dropped, and the rest is reduced in less than half the time.

    Args:
        system, start, width: as above, with the rows of the coefficients alone behind those of the last state.
        held: number of the last coefficients that fade along the chain.  root: written.
    """
    n, columns, p = len(start) - 2, system.shape[1], len(root.coefficients)
    carries, shared = np.zeros((BLOCK + 1, width, columns)), np.zeros((BLOCK + 1, p, columns))
    first = _reduce(system, start[: n + 1], width, held, carries, shared, root.states)
    if first < n:
        own = p - held
        kept = 2 * width + own
        rest, begins = np.zeros((start[n] - start[first], padded(kept + 1))), start[first : n + 1] - start[first]
        after, known = np.zeros((BLOCK + 1, width, rest.shape[1])), np.zeros((BLOCK + 1, own, rest.shape[1]))
        copy_kept(rest, system[start[first] : start[n]], kept)
        copy_kept(after[0], carries[0], kept)
        root.states[first:] = 0.0
        _reduce(rest, begins, width, 0, after, known, root.states[first:])
        more = np.zeros((own, columns))
        copy_kept(more, known[0], kept)
        absorb(shared[0], more, 0, own, 2 * width, p, np.empty(own))
    absorb(shared[0], system, start[n], start[n + 1], 2 * width, p, np.empty(start[n + 1] - start[n]))
    copy_kept(root.coefficients, shared[0], root.coefficients.shape[1] - 1)
