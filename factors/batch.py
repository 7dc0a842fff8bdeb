"""A batch evaluates all factors of one kind in a graph together.

GTSAM calls one factor at a time; torch is quick only on batches. So factors of one kind are one object here. It
computes whitened residuals and Jacobians of any of its rows in one call. The solver of this package uses those arrays
as they are (`ballfg.factors.linear.step`); GTSAM's own solvers see one CustomFactor per row (`ballfg.factors.bridge`).

Learning through an estimate also needs the residuals as a torch function of all learned quantities: the values, the
model's parameters, the noise.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self, TypeVar

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.factors.loss import Loss
from ballfg.state import STATE_DIM

if TYPE_CHECKING:
    from torch import Tensor

COEFFICIENTS = -1
"""The variable number of the coefficients shared by all factors; states have their index."""


@dataclass(frozen=True)
class Values:
    """A point at which a graph is evaluated.

    Attributes:
        states: (n, 9) position m, velocity m/s, spin rad/s.
        coefficients: (p,) the estimated coefficients, in their own units; (0,) without any.
        biases: (n, b) m, errors of the tracker that last from sample to sample; b is 3, or 0 without a memory.
    """

    states: Array
    coefficients: Array
    biases: Array | None = None

    @property
    def width(self) -> int:
        """Numbers at each time: 9 + b."""
        return STATE_DIM if self.biases is None else STATE_DIM + self.biases.shape[1]

    def gather(self, variables: Index, with_biases: bool = False) -> Array:
        """(m, d) values, in the variables' own units.

        Args:
            variables: (m,) index of each; all are states, or all are `COEFFICIENTS`.
            with_biases: True if the biases follow the states.
        """
        if len(variables) and variables[0] == COEFFICIENTS:
            return np.broadcast_to(self.coefficients, (len(variables), len(self.coefficients)))
        if with_biases and self.biases is not None:
            return np.concatenate((self.states[variables], self.biases[variables]), axis=1)
        return self.states[variables]

    def select(self, begin: int, end: int) -> Values:
        """The values of the states begin to end - 1, with the same coefficients."""
        biases = None if self.biases is None else self.biases[begin:end]
        return Values(self.states[begin:end], self.coefficients, biases)

    def retract(self, states: Array, coefficients: Array) -> Values:
        """These values plus a step.

        Args: states: (n, 9 + b) m, m/s, rad/s, m.  coefficients: (p,) in their own units.
        """
        if self.biases is None:
            return Values(self.states + states, self.coefficients + coefficients)
        own, biases = states[:, :STATE_DIM], states[:, STATE_DIM:]
        return Values(self.states + own, self.coefficients + coefficients, self.biases + biases)


@dataclass(frozen=True)
class Rows:
    """Linearised factors of one batch: whitened residuals r + J d, before the loss.

    Attributes:
        variables: (m, a) index of each variable.
        residual: (m, r) whitened.
        jacobians: a arrays (m, r, d) whitened, each per unit of its variable.
        loss: the loss on each residual's norm.
    """

    variables: Index
    residual: Array
    jacobians: tuple[Array, ...]
    loss: Loss

    def error(self) -> float:
        """Sum of the losses; infinite if a residual overflows when squared, as after a wild trial step."""
        if self.loss.name == "squared":
            flat = self.residual.ravel()
            return 0.5 * float(np.vdot(flat, flat))
        with np.errstate(over="ignore"):
            return float(self.loss.value(np.linalg.norm(self.residual, axis=-1)).sum())


@dataclass(frozen=True)
class Noise:
    """Learned noise as tensors; None for a part that stays as the factors were built.

    Attributes:
        process: (7,) the numbers of `ballfg.factors.noise.PROCESS_NOISE`.
        position: () dimensionless, factor on the standard deviation of every measured position.
        spin: () dimensionless, factor on that of the spins from labels or launcher settings.
    """

    process: Tensor | None = None
    position: Tensor | None = None
    spin: Tensor | None = None


class FactorBatch(ABC):
    """m factors of one kind, each between the same number of variables.

    Attributes:
        variables: (m, a) index of each factor's variables: that of a state, or `COEFFICIENTS`.
        dim: dimension of a residual.
        loss: the loss on the norm of a whitened residual.
        row_arrays: names of the attributes with one entry per factor.
        sees_biases: True if its variables are states with the tracker's biases behind them.
    """

    sees_biases: ClassVar[bool] = False

    row_arrays: ClassVar[tuple[str, ...]] = ("variables",)

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
            rows: (k,) index of the factors, or a slice.
            inputs: for each of the a variables its values (k, d), in the variable's own units.
        Returns: residuals (k, dim) whitened, and a Jacobians (k, dim, d) whitened, each per unit of its variable.
        """

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, dim) the whitened residuals of all rows, differentiable in the inputs and in the model.

        Only a gradient through the estimate needs this; estimation uses `compute` alone.

        Args: inputs: for each of the a variables its values (m, d), in the variable's own units.
        Raises: NotImplementedError: if the batch has none.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no residual in torch, so no gradient can pass through an estimate with it. "
            "Write its method `residual` (docs/custom_factors.md)."
        )

    def noise_scale(self, noise: Noise) -> Tensor | None:
        """The factor from whitened residuals to residuals whitened with learned noise, differentiable by that noise.

        Args: noise: the learned numbers.
        Returns: (m, dim, dim) lower triangular, or () for all rows; dimensionless. None if this noise is fixed.
        """
        return None

    def log_spread(self) -> float:
        """Half the log determinants of the noise covariances of all rows together.

        Zero for factors whose noise is never learned.
        """
        return 0.0

    @property
    def group(self) -> Hashable:
        """Batches with equal groups can be merged (see `merge`)."""
        return (type(self), self.dim, self.variables.shape[1], self.loss)

    def with_loss(self, loss: Loss) -> Self:
        """The same factors with another loss."""
        other = copy.copy(self)
        other.loss = loss
        return other

    def select(self, rows: Index | slice) -> Self:
        """A part of the factors, as a batch of its own; the variables keep their numbers.

        Args: rows: (k,) index of the factors, or a slice.
        """
        part = copy.copy(self)
        for name in self.row_arrays:
            setattr(part, name, getattr(self, name)[rows])
        return part

    def prepared(self) -> Self:
        """The same factors for a minimisation, during which their model and its coefficients stay as they are."""
        return self

    def inputs(self, values: Values) -> tuple[Array, ...]:
        """For each variable of a factor the values (m, d) for `compute`, in the variable's own units."""
        return tuple([values.gather(column, self.sees_biases) for column in self.variables.T])

    def linearize(self, values: Values) -> Rows:
        """All factors at a point."""
        inputs = self.inputs(values)
        return self.rows(values, *shaped(self, inputs, *self.compute(slice(None), inputs)))

    def rows(self, values: Values, residual: Array, jacobians: tuple[Array, ...]) -> Rows:
        """The linearised factors from the results of `compute` for all of them.

        Args:
            values: the point.
            residual: (m, dim) whitened.
            jacobians: (m, dim, d) whitened, each per unit of its variable; they get columns of zeros for biases.
        """
        more = values.width - STATE_DIM
        if more and not self.sees_biases:
            shared = (self.variables == COEFFICIENTS).any(axis=0)
            jacobians = tuple(
                j if of_coefficients else np.pad(j, ((0, 0), (0, 0), (0, more)))
                for j, of_coefficients in zip(jacobians, shared, strict=True)
            )
        return Rows(self.variables, residual, jacobians, self.loss)


def shaped(
    batch: FactorBatch, inputs: tuple[Array, ...], residual: Array, jacobians: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...]]:
    """The results of a batch, contiguous, after checks of number, shapes and type.

    Raises: ValueError: names the batch, the array and the rule.
    """
    count = len(inputs[0])
    if len(jacobians) != len(inputs):
        raise ValueError(
            f"{type(batch).__name__}.compute must return one Jacobian per variable, {len(inputs)}; got {len(jacobians)}"
            ". Return a tuple, in the order of variables; GTSAM ends the interpreter where one is left out."
        )
    _check_array(batch, "residual", residual, (count, batch.dim))
    for i, (block, own) in enumerate(zip(jacobians, inputs, strict=True)):
        _check_array(batch, i, block, (count, batch.dim, own.shape[-1]))
    return np.ascontiguousarray(residual), tuple([np.ascontiguousarray(block) for block in jacobians])


def _check_array(batch: FactorBatch, label: str | int, array: Array, shape: tuple[int, ...]) -> None:
    """Refuses another kind, shape or type; label: `residual`, or the number of a Jacobian. Raises: ValueError."""
    if isinstance(array, np.ndarray) and array.shape == shape and array.dtype == np.float64:
        return
    what = f"{type(batch).__name__}.compute: {label if isinstance(label, str) else f'Jacobian {label}'}"
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{what} must be a numpy array of shape {shape}; got {type(array).__name__}")
    if array.shape != shape:
        raise ValueError(f"{what} must have shape {shape}; got {array.shape}")
    raise ValueError(f"{what} must be float64; got {array.dtype}. Convert the model with .double().")


class DiagonalFactors(FactorBatch):
    """Factors whose numbers have independent noise.

    Attributes: information_root: (m, dim) one over the standard deviations, one over the numbers' own units.
    """

    information_root: Array

    def log_spread(self) -> float:
        """Sum of the logarithms of all standard deviations."""
        return -float(np.log(self.information_root).sum())


def check_measured(count: int, measured: Array, sigma: Array) -> None:
    """Refuses measured positions or standard deviations, (m, 3) m each, of a wrong shape or without use."""
    if measured.shape != (count, 3) or sigma.shape != (count, 3):
        raise ValueError(f"measured and sigma must have shape ({count}, 3); got {measured.shape} and {sigma.shape}")
    if not (np.isfinite(measured).all() and (sigma > 0).all()):
        raise ValueError("measured must be finite and sigma positive; remove the samples that are not")


B = TypeVar("B", bound=FactorBatch)


def merge(batches: Sequence[B]) -> B:
    """One batch with the rows of several of the same group, in order; variables keep their numbers."""
    if len(batches) == 1:
        return batches[0]
    whole = copy.copy(batches[0])
    for name in whole.row_arrays:
        setattr(whole, name, np.concatenate([getattr(batch, name) for batch in batches]))
    return whole
