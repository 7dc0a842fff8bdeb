"""Checks every Jacobian block of a batch of factors against central differences."""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values

STEP = 1e-4
"""Step of the differences, relative to a number's size, absolute below 1. The five-point rule's own error is of order
step^4, rounding of order 1e-16 / step: both stay near 1e-12 relative."""


@dataclass(frozen=True)
class BlockError:
    """The error of one Jacobian block against differences of the residual.

    Attributes:
        row: of the batch.  column: which variable of the factor.  variable: its number.
        entry: (i, j) of the worst element.  given: value of `compute` there.  difference: value of the differences.
        relative: their distance over the block's largest element.
    """

    row: int
    column: int
    variable: int
    entry: tuple[int, int]
    given: float
    difference: float
    relative: float

    def __str__(self) -> str:
        name = "c" if self.variable == COEFFICIENTS else f"x{self.variable}"
        return (
            f"row {self.row}, block {self.column} (by {name}), entry {self.entry}: compute gives {self.given:.9g}, "
            f"central differences {self.difference:.9g}, {self.relative:.1e} of the block's largest element"
        )


def jacobian_errors(batch: FactorBatch, values: Values, step: float = STEP) -> list[BlockError]:
    """One entry per row and block: `compute`'s Jacobians against five-point central differences of its residuals.

    Args: values: a point, preferably with nonzero residuals.  step: see `STEP`.
    """
    inputs = tuple(np.array(values.gather(column)) for column in batch.variables.T)
    _, jacobians = batch.compute(slice(None), inputs)
    errors = []
    for column, given in enumerate(jacobians):
        difference = _differences(batch, inputs, column, step)
        scale = np.maximum(np.abs(difference).max(axis=(1, 2)), np.finfo(float).tiny)
        off = np.abs(given - difference) / scale[:, None, None]
        off = np.where(np.isfinite(off), off, np.inf)
        for row in range(len(batch)):
            i, j = map(int, np.unravel_index(int(off[row].argmax()), off[row].shape))
            found = (float(array[row, i, j]) for array in (given, difference, off))
            errors.append(BlockError(row, column, int(batch.variables[row, column]), (i, j), *found))
    return errors


def check_factor(batch: FactorBatch, values: Values, tolerance: float = 1e-6, step: float = STEP) -> float:
    """The worst relative error of a batch's Jacobians.

    Args: batch: any.  values: the point.  tolerance: relative to a block's largest element.  step: see `STEP`.
    Raises: AssertionError: if the error of a block is larger; the message names the worst. If a row by itself, as
        filters and GTSAM ask for it, is not that of the whole batch.
    """
    worst = max(jacobian_errors(batch, values, step), key=lambda error: error.relative)
    if not worst.relative <= tolerance:
        raise AssertionError(f"{type(batch).__name__}: {worst}; allowed {tolerance:.1e}")
    _check_rows(batch, values)
    return worst.relative


def _check_rows(batch: FactorBatch, values: Values) -> None:
    """Compares every row by itself with that of the whole batch.

    Raises: AssertionError: naming the first that differs.
    """
    whole = batch.linearize(values).residual
    inputs = batch.inputs(values)
    for row in range(len(batch)):
        own, only = tuple(block[[row]] for block in inputs), np.array([row])
        try:
            alone = [batch.compute(only, own)[0], batch.select(only).compute(slice(None), own)[0]]
            same = all(np.allclose(one, whole[only], equal_nan=True) for one in alone)
        except (IndexError, ValueError):  # numpy's, where arrays of one row meet arrays of all
            same = False
        if not same:
            raise AssertionError(
                f"{type(batch).__name__}: row {row} by itself must be that of the whole batch. Name all attributes "
                "with one entry a factor in row_arrays, and index them by rows in compute."
            )


def _differences(batch: FactorBatch, inputs: tuple[Array, ...], column: int, step: float) -> Array:
    """(m, r, d) derivative of the residuals by one variable, (8 (f1 - f-1) - (f2 - f-2)) / 12h."""
    block = inputs[column]
    result = np.empty((len(block), batch.dim, block.shape[-1]))
    for j in range(block.shape[-1]):
        h = step * np.maximum(np.abs(block[:, j]), 1.0)
        at = {}
        for shift in (-2, -1, 1, 2):
            moved = block.copy()
            moved[:, j] += shift * h
            at[shift] = batch.compute(slice(None), (*inputs[:column], moved, *inputs[column + 1 :]))[0]
        result[:, :, j] = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * h[:, None])
    return result
