"""Solves the linear subproblem by QR, state by state along the track, for the step of a minimisation."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array, Index, plain
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, INDEX, NOTHING, REAL, THREE, TWO
from ballfg.factors.batch import COEFFICIENTS, Rows, Values
from ballfg.factors.linear import elimination
from ballfg.factors.linear.elimination import Root
from ballfg.factors.linear.substitution import solution_of

Piece = tuple[Index, Array, tuple[Array, ...]]
"""Variables (m, a), weighted residuals (m, r) and weighted Jacobians of some factors."""
WAITING = -2
"""The variable number of a state that waits behind the coefficients until all others are eliminated."""


@dataclass(frozen=True)
class Step:
    """A solution of the linear subproblem.

    Attributes:
        states: (n, 9 + b) m, m/s, rad/s, and m of biases: part of the step d that minimises |r + J d|^2 (+ damping).
        coefficients: (p,) in their own units, the other part of it.  root: the triangle of the elimination.
        decrease: half of |r|^2 - |r + J d|^2, the decrease of the objective predicted by the linear model.
    """

    states: Array
    coefficients: Array
    root: Root
    decrease: float

    @classmethod
    def of(cls, root: Root, states: Array, coefficients: Array, damping: float, diagonal: Array) -> "Step | None":
        """The step R d = y with its predicted decrease; None if it is not finite.

        Args:
            root: R and y.  states: (n, 9 + b) m, m/s, rad/s, m, and
            coefficients: (p,) in their own units: d.  damping: Marquardt's lambda.
            diagonal: (n + 1, w + p) of `damped_rows`, each in the inverse square of its unit.
        """
        if not (np.isfinite(states).all() and np.isfinite(coefficients).all()):
            return None
        n, w, p = len(states), root.width, len(coefficients)
        # |J d|^2 and the share of the damping rows in it
        promised = float((root.states[..., -1] ** 2).sum() + (root.coefficients[:, -1] ** 2).sum())
        if damping:
            held = (diagonal[:n, :w] * states**2).sum() + (diagonal[n, :p] * coefficients**2).sum()
            promised += damping * float(held)
        return cls(states, coefficients, root, 0.5 * promised)

    def change_of(self, rows: Rows) -> Array:
        """(m, r) J d, by which the linear model changes the residuals of some factors."""
        moved = np.zeros_like(rows.residual)
        for variables, jacobian in zip(rows.variables.T, rows.jacobians, strict=True):
            if len(variables) and variables[0] == COEFFICIENTS:
                moved += jacobian @ self.coefficients
            else:
                moved += (jacobian @ self.states[variables, : jacobian.shape[2], None])[..., 0]
        return moved


def weighted(rows: Rows) -> tuple[Array, tuple[Array, ...]]:
    """Residuals and Jacobians such that J^T r is the gradient of the losses and J^T J close to their Hessian.

    The weight w = rho'/d scales both; along the residual the Jacobian shrinks further, by the root of the loss's
    `stretch`, and the residual grows by as much (Triggs et al., "Bundle adjustment - a modern synthesis", 2000, 4.3).
    """
    if rows.loss.name == "squared":
        return rows.residual, rows.jacobians
    norm = np.linalg.norm(rows.residual, axis=-1)
    root, along = np.sqrt(rows.loss.weight(norm)), np.sqrt(rows.loss.stretch(norm))
    unit = rows.residual / np.maximum(norm, np.finfo(float).tiny)[:, None]
    radial = ((1.0 - along)[:, None] * unit)[..., None] * unit[:, None, :]
    turn = root[:, None, None] * (np.eye(unit.shape[-1]) - radial)
    return rows.residual * (root / along)[:, None], tuple(turn @ j for j in rows.jacobians)


def solve(linearized: Sequence[Rows], values: Values, damping: float = 0.0) -> Step | None:
    """Minimises the linearised, reweighted objective.

    Args:
        linearized: all batches of a graph at `values`.  values: the point; its shapes give the variables.
        damping: Marquardt's lambda, relative to the diagonal of J^T J.
    Returns: None if the system is singular or its solution is not finite.
    Raises: ValueError: if a factor links states that are not neighbours.
    """
    system, start, diagonal = damped_rows(linearized, values, damping)
    root = Root.empty(len(values.states), values.width, len(values.coefficients))
    elimination.eliminate(system, start, values.width, 0, root)
    return Step.of(root, *solution_of(root), damping, diagonal)


def damped_rows(
    linearized: Sequence[Rows], values: Values, damping: float, held: int = 0
) -> tuple[Array, Index, Array]:
    """All rows of the linear problem, ordered by their first states, with those of the damping.

    Args:
        linearized, values, damping: as for `solve`.
        held: number of the last coefficients, which are not `COEFFICIENTS` but the variable `WAITING`.
    Returns: rows (r, c) as `elimination` takes them; where the rows of each state begin (n + 2,), those of the
        coefficients last; diagonal (n + 1, w + p) of J^T J, zeros without damping.
    Raises: ValueError: if a factor links states that are not neighbours.
    """
    n, p, w = len(values.states), len(values.coefficients), values.width
    pieces = [(rows.variables, *weighted(rows)) for rows in linearized]
    system, start, free = _system(pieces, n, p - held, p, w, further=damping > 0.0)
    diagonal = np.zeros((n + 1, w + p))
    if damping:
        damp(system, start, free, w, damping, diagonal)
    return system, start, diagonal


def _system(
    pieces: Sequence[Piece], n: int, own: int, p: int, width: int, *, further: bool
) -> tuple[Array, Index, Index]:
    """All rows, ordered by their first states; where each state's rows begin, and where free ones do.

    Args: own: coefficients before those that wait.  further: leave room for a row for each unknown.
    """
    counts = np.zeros(n + 1, dtype=np.int64)
    for variables, residual, _ in pieces:
        wrong = count_rows(counts, plain(variables), residual.shape[1])
        if wrong >= 0:
            linked = sorted({int(v) for v in variables[wrong] if v >= 0})
            raise ValueError(
                f"a factor must look at one state or at two neighbours; one looks at the states {linked}. Give it the "
                "state before its last, or a coefficient, in place of those further away."
            )
    if further:
        counts += np.append(np.full(n, width), p)
    start = np.concatenate(([0], np.cumsum(counts)))
    free, system = start[:-1].copy(), np.zeros((start[-1], elimination.padded(2 * width + p + 1)))
    for variables, residual, jacobians in pieces:
        rows, firsts = np.empty(len(variables), dtype=np.int64), np.empty(len(variables), dtype=np.int64)
        place_residuals(system, free, plain(variables), plain(residual), rows, firsts)
        for which, block in enumerate(jacobians):
            place_block(system, width, own, rows, firsts, plain(variables), which, plain(block))
    return system, start, free


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
