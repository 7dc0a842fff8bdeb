"""The linear subproblem: GTSAM eliminates the linearised graph, by QR, state by state along the track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from ballfg.factors.kind import COEFFICIENTS, Array, Rows, Values


@dataclass(frozen=True)
class Step:
    """A solution of the linear subproblem.

    Attributes:
        states: (n, 9) and coefficients: (p,): the step d that minimises |r + J d|^2 (+ damping).
        bayes_net: GTSAM's result of the elimination, states in order, coefficients last.
        decrease: half of |r|^2 - |r + J d|^2, what the linear model promises.
    """

    states: Array
    coefficients: Array
    bayes_net: gtsam.GaussianBayesNet
    decrease: float


def weighted(rows: Rows) -> tuple[Array, tuple[Array, ...]]:
    """Residuals and Jacobians such that J^T r is the gradient of the losses and J^T J close to their Hessian.

    The weight w = rho'/d scales both; along the residual the Jacobian shrinks further, by the root of the loss's
    `stretch`, and the residual grows by as much (B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000, 4.3).
    """
    if rows.loss.name == "squared":
        return rows.residual, rows.jacobians
    norm = np.linalg.norm(rows.residual, axis=-1)
    root, along = np.sqrt(rows.loss.weight(norm)), np.sqrt(rows.loss.stretch(norm))
    unit = rows.residual / np.maximum(norm, np.finfo(float).tiny)[:, None]
    turn = root[:, None, None] * (np.eye(unit.shape[-1]) - ((1.0 - along)[:, None] * unit)[..., None] * unit[:, None, :])
    return rows.residual * (root / along)[:, None], tuple(turn @ j for j in rows.jacobians)


def solve(linearized: Sequence[Rows], values: Values, damping: float = 0.0) -> Step:
    """Minimise the linearised, reweighted objective.

    Args:
        linearized: all kinds of a graph at `values`.
        values: the point; its shapes give the variables.
        damping: Marquardt's lambda, relative to the diagonal of J^T J.

    Raises: RuntimeError: from GTSAM, when the system is singular; its text holds `Indetermin`.
    """
    n, p = len(values.states), len(values.coefficients)
    graph, decrease = gtsam.GaussianFactorGraph(), 0.0
    diagonal, gradient = np.zeros((n + 1, 9 + p)), 0.0
    pieces = []
    for rows in linearized:
        residual, jacobians = weighted(rows)
        pieces.append((rows.variables, residual, jacobians))
        _append(graph, np.where(rows.variables == COEFFICIENTS, n, rows.variables), residual, jacobians)
        if damping:
            for column, jacobian in zip(rows.variables.T, jacobians, strict=True):
                squares = (jacobian**2).sum(axis=1)
                np.add.at(diagonal[:, : squares.shape[-1]], np.where(column == COEFFICIENTS, n, column), squares)
    if damping:
        _damp(graph, np.sqrt(damping * diagonal), n, p)
    ordering = gtsam.Ordering()
    for key in range(n + (p > 0)):
        ordering.push_back(key)
    bayes_net = graph.eliminateSequential(ordering, gtsam.EliminateQR)
    solution = bayes_net.optimize()
    states = solution.vector(list(range(n))).reshape(n, 9)
    coefficients = solution.at(n) if p else np.zeros(0)
    for variables, residual, jacobians in pieces:
        change = _apply(variables, jacobians, states, coefficients)
        gradient -= float((residual * change).sum())
        decrease -= float((residual * change).sum() + 0.5 * (change**2).sum())
    return Step(states, coefficients, bayes_net, decrease)


def _append(graph: gtsam.GaussianFactorGraph, keys: Array, residual: Array, jacobians: tuple[Array, ...]) -> None:
    unit = gtsam.noiseModel.Unit.Create(residual.shape[-1])
    factor, b = gtsam.JacobianFactor, -residual
    push = graph.push_back
    if len(jacobians) == 1:
        (first,) = jacobians
        for i, key in enumerate(keys[:, 0].tolist()):
            push(factor(key, first[i], b[i], unit))
    elif len(jacobians) == 2:
        first, second = jacobians
        for i, (key, other) in enumerate(keys.tolist()):
            push(factor(key, first[i], other, second[i], b[i], unit))
    else:
        first, second, third = jacobians
        for i, (key, other, last) in enumerate(keys.tolist()):
            push(factor(key, first[i], other, second[i], last, third[i], b[i], unit))


def _damp(graph: gtsam.GaussianFactorGraph, root: Array, n: int, p: int) -> None:
    for key, d in [(i, 9) for i in range(n)] + [(n, p)] * (p > 0):
        graph.push_back(
            gtsam.JacobianFactor(key, np.diag(root[key, :d]), np.zeros(d), gtsam.noiseModel.Unit.Create(d))
        )


def _apply(variables: Array, jacobians: tuple[Array, ...], states: Array, coefficients: Array) -> Array:
    """(m, r) J d of some rows."""
    total = 0.0
    for column, jacobian in zip(variables.T, jacobians, strict=True):
        step = coefficients if len(column) and column[0] == COEFFICIENTS else states[column][..., None]
        total = total + (jacobian @ step if step.ndim == 1 else (jacobian @ step)[..., 0])
    return np.asarray(total)
