"""The linear subproblem: GTSAM eliminates the linearised graph, by QR, state by state along the track."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.factors.batch import COEFFICIENTS, Rows, Values

Piece = tuple[Index, Array, tuple[Array, ...]]
"""Variables (m, a), weighted residuals (m, r) and weighted Jacobians of some factors."""


@dataclass(frozen=True)
class Step:
    """A solution of the linear subproblem.

    Attributes:
        states: (n, 9 + b) m, m/s, rad/s, and m of biases: part of the step d that minimises |r + J d|^2 (+ damping).
        coefficients: (p,) in their own units, the other part of it.
        bayes_net: GTSAM's result of the elimination, states in order, coefficients last.
        decrease: half of |r|^2 - |r + J d|^2, by which the linear model promises to reduce the objective.
    """

    states: Array
    coefficients: Array
    bayes_net: gtsam.GaussianBayesNet
    decrease: float


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
    """Minimise the linearised, reweighted objective.

    Args:
        linearized: all batches of a graph at `values`.
        values: the point; its shapes give the variables.
        damping: Marquardt's lambda, relative to the diagonal of J^T J.
    Returns: None where the system is singular or its solution is not finite.
    """
    n, p, width = len(values.states), len(values.coefficients), values.width
    pieces = [(rows.variables, *weighted(rows)) for rows in linearized]
    graph = gtsam.GaussianFactorGraph()
    for variables, residual, jacobians in _folded(pieces, n):
        _append(graph, np.where(variables == COEFFICIENTS, n, variables), residual, jacobians)
    if damping:
        _damp(graph, np.sqrt(damping * _diagonal(pieces, n, p, width)), n, p, width)
    try:
        bayes_net = graph.eliminateSequential(_in_order(n + (p > 0)), gtsam.EliminateQR)
        solution = bayes_net.optimize()
    except RuntimeError as error:  # GTSAM's text changed between versions; the word did not
        if "Indetermin" not in str(error):
            raise
        return None
    states = solution.vector(list(range(n))).reshape(n, width)
    coefficients = solution.at(n) if p else np.zeros(0)
    if not np.isfinite(states).all():
        return None
    decrease = 0.0
    for variables, residual, jacobians in pieces:
        change = _apply(variables, jacobians, states, coefficients)
        decrease -= float((residual * change).sum() + 0.5 * (change**2).sum())
    return Step(states, coefficients, bayes_net, decrease)


@functools.lru_cache(maxsize=256)
def _in_order(count: int) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for key in range(count):
        ordering.push_back(key)
    return ordering


def _folded(pieces: Sequence[Piece], n: int) -> list[Piece]:
    """The same rows in fewer factors: those on one state alone join the factor that leads on from that state.

    Building a factor from Python costs more than eliminating it.
    """
    single = next((i for i, (v, _, _) in enumerate(pieces) if v.shape[1] == 1 and _distinct_states(v[:, 0])), None)
    if single is None:
        return list(pieces)
    variables, residual, (jacobian,) = pieces[single]
    place = np.full(n, -1)
    place[variables[:, 0]] = np.arange(len(variables))
    folded = []
    for i, (others, r, blocks) in enumerate(pieces):
        rows = place[others[:, 0]] if others.shape[1] > 1 else np.array([-1])
        if i == single or (rows < 0).any():
            continue
        place[others[:, 0]] = -1
        joined = [np.concatenate((blocks[0], jacobian[rows]), axis=1)]
        for block in blocks[1:]:
            joined.append(np.concatenate((block, np.zeros((len(rows), residual.shape[1], block.shape[2]))), axis=1))
        folded.append((i, (others, np.concatenate((r, residual[rows]), axis=1), tuple(joined))))
    taken = {single, *(i for i, _ in folded)}
    left = place[variables[:, 0]] >= 0
    rest = [piece for i, piece in enumerate(pieces) if i not in taken]
    return [piece for _, piece in folded] + [*rest, (variables[left], residual[left], (jacobian[left],))]


def _distinct_states(variables: Index) -> bool:
    return len(variables) > 1 and bool(variables.min() >= 0) and len(np.unique(variables)) == len(variables)


def _diagonal(pieces: Sequence[Piece], n: int, p: int, width: int) -> Array:
    """(n + 1, 9 + b + p) diagonal of J^T J; the coefficients stand in row n."""
    diagonal = np.zeros((n + 1, width + p))
    for variables, _, jacobians in pieces:
        for column, jacobian in zip(variables.T, jacobians, strict=True):
            squares = (jacobian**2).sum(axis=1)
            np.add.at(diagonal[:, : squares.shape[-1]], np.where(column == COEFFICIENTS, n, column), squares)
    return diagonal


def _append(graph: gtsam.GaussianFactorGraph, keys: Index, residual: Array, jacobians: tuple[Array, ...]) -> None:
    unit = gtsam.noiseModel.Unit.Create(residual.shape[-1])
    factor, push = gtsam.JacobianFactor, graph.push_back
    for key, b, *blocks in zip(keys.tolist(), -residual, *jacobians, strict=True):
        if len(blocks) == 1:
            push(factor(key[0], blocks[0], b, unit))
        elif len(blocks) == 2:
            push(factor(key[0], blocks[0], key[1], blocks[1], b, unit))
        else:
            push(factor(key[0], blocks[0], key[1], blocks[1], key[2], blocks[2], b, unit))


def _damp(graph: gtsam.GaussianFactorGraph, root: Array, n: int, p: int, width: int) -> None:
    for key, d in [(i, width) for i in range(n)] + [(n, p)] * (p > 0):
        graph.push_back(gtsam.JacobianFactor(key, np.diag(root[key, :d]), np.zeros(d), gtsam.noiseModel.Unit.Create(d)))


def _apply(variables: Index, jacobians: tuple[Array, ...], states: Array, coefficients: Array) -> Array:
    """(m, r) J d of some rows."""
    total = np.zeros(jacobians[0].shape[:2])
    for column, jacobian in zip(variables.T, jacobians, strict=True):
        if len(column) and column[0] == COEFFICIENTS:
            total += jacobian @ coefficients
        else:
            total += (jacobian @ states[column][..., None])[..., 0]
    return total
