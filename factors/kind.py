"""A kind of factors: all factors of one sort in a graph, evaluated together.

GTSAM asks one factor at a time; torch is quick only on batches. So factors of one sort are one object here. It computes
whitened residuals and Jacobians of any of its rows in one call. The solver of this package takes those arrays
as they are (`ballfg.factors.linear`); GTSAM's own solvers see one CustomFactor per row (`ballfg.factors.bridge`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.factors.loss import Loss

Array = NDArray[np.float64]
Index = NDArray[np.int64]

COEFFICIENTS = -1
"""The variable number of the coefficients shared by all factors; states have their index."""


@dataclass(frozen=True)
class Values:
    """A point at which a graph is evaluated.

    Attributes:
        states: (n, 9).
        coefficients: (p,) of the model's coefficients that are estimated; (0,) for none.
    """

    states: Array
    coefficients: Array

    def gather(self, variables: Index) -> Array:
        """(m, d) values of m variables of one sort."""
        if len(variables) and variables[0] == COEFFICIENTS:
            return np.broadcast_to(self.coefficients, (len(variables), len(self.coefficients)))
        return self.states[variables]

    def moved(self, states: Array, coefficients: Array) -> Values:
        """These values plus a step."""
        return Values(self.states + states, self.coefficients + coefficients)


@dataclass(frozen=True)
class Rows:
    """Linearised factors of one kind: whitened residuals r + J d, before the loss.

    Attributes:
        variables: (m, a) variable numbers.
        residual: (m, r).
        jacobians: a arrays (m, r, d).
        loss: the loss on each residual's norm.
    """

    variables: Index
    residual: Array
    jacobians: tuple[Array, ...]
    loss: Loss

    def error(self) -> float:
        """Sum of the losses."""
        return float(self.loss.value(np.linalg.norm(self.residual, axis=-1)).sum())


class FactorKind(ABC):
    """m factors of one sort, each between the same number of variables.

    Attributes:
        variables: (m, a) numbers of the variables of each factor: a state's index or `COEFFICIENTS`.
        dim: dimension of a residual.
        loss: the loss on the norm of a whitened residual.
    """

    def __init__(self, variables: Index, dim: int, loss: Loss | None = None) -> None:
        self.variables = np.asarray(variables, dtype=np.int64)
        self.dim = dim
        self.loss = loss or Loss()

    def __len__(self) -> int:
        return len(self.variables)

    @abstractmethod
    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals and Jacobians of some rows.

        Args:
            rows: which of the m factors, k of them.
            inputs: for each of the a variables the values (k, d).
        Returns: residuals (k, dim) and a Jacobians (k, dim, d).
        """

    def linearize(self, values: Values) -> Rows:
        """All factors at a point."""
        inputs = tuple(values.gather(column) for column in self.variables.T)
        residual, jacobians = self.compute(slice(None), inputs)
        return Rows(self.variables, residual, jacobians, self.loss)
