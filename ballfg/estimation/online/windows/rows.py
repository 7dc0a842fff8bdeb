"""Writes the rows of a chain's factors: of many states in a few calls, since a call costs more than a row.

The columns are those of a state, the next one, the coefficients, zeros and the right side. The rows of linear factors
are kept once, about zero: a moved state changes only their right side.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNTS, INDEX, NOTHING, ONE, TWO
from ballfg.factors.batch import COEFFICIENTS, FactorBatch
from ballfg.factors.loss import weight_of
from ballfg.state import STATE_DIM


class Answer(NamedTuple):
    """What a factor answered: residual (r,) and Jacobians (r, d), whitened, and the first column of each of these."""

    batch: FactorBatch
    residual: Array
    blocks: tuple[Array, ...]
    columns: tuple[int, ...]


def write_answers(answers: Sequence[Answer], begins: Sequence[int], written: Array) -> None:
    """Writes what nonlinear factors answered, weighted by robust losses.

    Args: begins: the first row of each.  written: (r, columns).
    """
    alike: dict[tuple[object, ...], list[int]] = {}
    for i, answer in enumerate(answers):
        alike.setdefault((len(answer.residual), answer.columns), []).append(i)
    for members in alike.values():
        first = answers[members[0]]
        rows = np.array([begins[i] for i in members])[:, None] + np.arange(len(first.residual))
        written[rows, -1] = -np.array([answers[i].residual for i in members])
        for place, at in enumerate(first.columns):
            blocks = np.array([answers[i].blocks[place] for i in members])
            written[rows, at : at + blocks.shape[2]] = blocks
    for answer, begin in zip(answers, begins, strict=True):
        if answer.batch.loss.name != "squared":  # as in GTSAM's noise models
            size = np.sqrt(answer.residual @ answer.residual)
            written[begin : begin + len(answer.residual)] *= math.sqrt(float(answer.batch.loss.weight(size)))


class LinearRows:
    """The rows J x = b of linear factors on a state, the next one and the coefficients, in the columns of a chain.

    Args:
        batches: of one factor each.  width: w, numbers of a state.  p: number of coefficients.
        columns: of the chain's rows, (x_i, x_{i+1}, c, 0, b).

    Attributes:
        dim: r.  rows: (r, columns) whitened.
        losses: (g, 3) of each batch with a robust loss: first row, end, the loss's number.  scales: (g,) theirs.
    """

    def __init__(self, batches: Sequence[FactorBatch], width: int, p: int, columns: int) -> None:
        self.rows = np.zeros((sum(batch.dim for batch in batches), columns))
        losses, row = list[tuple[int, int, int]](), 0
        for batch in batches:
            part = self.rows[row : row + batch.dim]
            own, seen = width if batch.sees_biases else STATE_DIM, batch.variables[0].tolist()
            origin = tuple(np.zeros((1, p if variable == COEFFICIENTS else own)) for variable in seen)
            (residual,), blocks = batch.compute(slice(None), origin)
            write_factor(batch, blocks, width, part)
            part[:, -1] = -residual
            if batch.loss.name != "squared":
                losses.append((row, row + batch.dim, batch.loss.kind))
            row += batch.dim
        self.dim = row
        self.losses = np.array(losses, dtype=np.int64).reshape(-1, 3)
        self.scales = np.array([batch.loss.scale for batch in batches if batch.loss.name != "squared"])


def write_linear(
    parts: Sequence[LinearRows], states: Index, begins: Index, points: Array, coefficients: Array, written: Array
) -> None:
    """Writes the rows of linear factors about other points, weighted by robust losses.

    Args:
        states: (m,) the state of each of m parts.  begins: (m,) its first row in `written`.
        points: (n, w) of all states.  coefficients: (p,).  written: (r, columns).
    """
    rows = np.concatenate([part.rows for part in parts])
    dims = np.array([part.dim for part in parts])
    ends = dims.cumsum()
    target = np.arange(len(rows)) + np.repeat(begins - ends + dims, dims)
    losses = np.concatenate([part.losses for part in parts])
    losses[:, :2] += np.repeat(begins, [len(part.losses) for part in parts])[:, None]
    scales = np.concatenate([part.scales for part in parts])
    _about(rows, np.repeat(states, dims), target, losses, scales, points, coefficients, written)


def columns_of(batch: FactorBatch, width: int) -> tuple[int, ...]:
    """The first column of each variable of a batch of one factor, in the rows of a chain."""
    seen = batch.variables[0].tolist()
    return tuple([2 * width if variable == COEFFICIENTS else place * width for place, variable in enumerate(seen)])


def write_factor(batch: FactorBatch, blocks: Sequence[Array], width: int, rows: Array) -> None:
    """Writes the Jacobians (1, r, d) of a batch of one factor into the columns of its variables, rows (r, columns)."""
    for at, (block,) in zip(columns_of(batch, width), blocks, strict=True):
        rows[:, at : at + block.shape[1]] = block


@machine_code(NOTHING(TWO, COUNTS, COUNTS, INDEX, ONE, TWO, ONE, TWO))
def _about(
    linear: Array,
    states: Index,
    target: Index,
    losses: Index,
    scales: Array,
    points: Array,
    coefficients: Array,
    written: Array,
) -> None:
    """As `write_linear`, of each row's state (r,) and place (r,) among the written ones."""
    columns, width, last = linear.shape[1], points.shape[1], len(points) - 1
    for i in range(len(linear)):
        right, here, row = linear[i, columns - 1], states[i], target[i]
        after = min(here + 1, last)
        for j in range(columns - 1):
            written[row, j] = linear[i, j]
        for j in range(width):
            right -= linear[i, j] * points[here, j] + linear[i, width + j] * points[after, j]
        for j in range(len(coefficients)):
            right -= linear[i, 2 * width + j] * coefficients[j]
        written[row, columns - 1] = right
    for g in range(len(losses)):
        begin, end, square = losses[g, 0], losses[g, 1], 0.0
        for i in range(begin, end):
            square += written[i, columns - 1] ** 2
        weight = math.sqrt(weight_of(losses[g, 2], scales[g], square))
        for i in range(begin, end):
            for j in range(columns):
                written[i, j] *= weight
