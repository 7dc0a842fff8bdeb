"""Eliminates the first states from the linearised problem, stretch by stretch.

The best first state absorbs a part of each common column; tests and fits need only the inner products of the rest.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.diagnosis.fit.stretches import Batch, batches_of
from ballfg.factors.linear.elimination import eliminate_each, padded
from ballfg.state import STATE_DIM


@dataclass(frozen=True)
class Eliminated:
    """A system without its first states."""

    solved: Array  # (n, 9, q + 1) first states that absorb each column, the residual last
    left: tuple[tuple[Index, Array], ...]  # Numbers (b,) of alike stretches, and what they leave of each column, turned

    @cached_property
    def gram(self) -> Array:
        """(n, q + 1, q + 1) inner products of projected columns, the residual last."""
        # about a path far off squares overflow: what it gives is not finite and loses
        with np.errstate(over="ignore", invalid="ignore"):
            grams = [left.swapaxes(-1, -2) @ left for _, left in self.left]
        found = np.empty((len(self.solved), *grams[0].shape[1:]))
        for (numbers, _), gram in zip(self.left, grams, strict=True):
            found[numbers] = gram
        return found

    def common_step(self, precision: Array, pull: Array, low: Array, high: Array, damping: float = 0.0) -> Array:
        """(q,) best step of the common unknowns within limits.

        Args: precision: (q,) of the priors.  pull: (q,) prior mean minus present value, times the precision.
        """
        total = self.gram.sum(axis=0)
        return bounded_step(total[:-1, :-1] + np.diag(precision), total[:-1, -1] + pull, low, high, damping)

    def start_step(self, common: Array) -> Array:
        """(n, 9) step of the first states that follows a step (q,) of the common unknowns."""
        return np.asarray(self.solved[..., -1] - self.solved[..., :-1] @ common)


@dataclass(frozen=True)
class System:
    """Whitened rows of n stretches: m is the number of samples' coordinates plus three for the spin."""

    residual: Array  # (n, m) measured minus predicted
    by_start: Array  # (n, m, 9) derivative of the prediction by the first state
    by_common: Array  # (n, m, q) derivative of the prediction by the unknowns that all stretches share
    used: Mask | None = None  # (n, k) samples that there are, the others' rows are zero; None: all

    @property
    def columns(self) -> Array:
        """(n, m, q + 1) common columns, then the residual."""
        return np.concatenate((self.by_common, self.residual[..., None]), axis=-1)

    @property
    def start_information(self) -> Array:
        """(n, 9, 9) information of the first states; one for an undetermined number, which so stays."""
        found, diagonal = self.by_start.swapaxes(-1, -2) @ self.by_start, np.arange(STATE_DIM)
        found[:, diagonal, diagonal] += found[:, diagonal, diagonal] == 0.0
        return np.asarray(found)

    def eliminated(self, damping: float = 0.0) -> Eliminated:
        """The first states solved for in terms of everything else; `damping` as in Levenberg-Marquardt."""
        diagonal, end, left = np.arange(STATE_DIM), STATE_DIM + self.by_common.shape[-1] + 1, []
        solved = np.zeros((len(self.residual), STATE_DIM, end - STATE_DIM))
        for batch in [Batch(*map(np.arange, self.residual.shape))] if self.used is None else batches_of(self.used):
            by_start = batch.of(self.by_start)
            rows, upper = (np.zeros((len(by_start), count, padded(end))) for count in (by_start.shape[1], STATE_DIM))
            rows[..., :STATE_DIM], rows[..., STATE_DIM : end - 1] = by_start, batch.of(self.by_common)
            rows[..., end - 1] = batch.of(self.residual)
            squares = np.einsum("nmi,nmi->ni", by_start, by_start)
            upper[:, diagonal, diagonal] = np.sqrt((squares == 0.0) + damping * np.where(squares == 0.0, 1.0, squares))
            eliminate_each(rows, upper)
            solved[batch.numbers] = np.linalg.solve(upper[..., :STATE_DIM], upper[..., STATE_DIM:end])
            left.append((batch.numbers, rows[..., STATE_DIM:end]))
        return Eliminated(solved, tuple(left))

    def start_correction(self, residual: Array) -> Array:
        """(n, 9) step of the first states alone against another residual (n, m), with the same derivatives."""
        return System(residual, self.by_start, self.by_common[..., :0], self.used).eliminated().solved[..., 0]


def bounded_step(hessian: Array, gradient: Array, low: Array, high: Array, damping: float = 0.0) -> Array:
    """(q,) the step of a Levenberg-Marquardt method within limits.

    The first unknown whose step would pass its limit ends there, and the others are solved again with it fixed, until
    none passes: their full step would count on a change that does not happen.

    Args:
        hessian, gradient: (q, q) and (q,) of the objective, the gradient downhill.
        low, high: (q,) limits of the step.
        damping: share of the hessian's diagonal that is added to it.
    """
    damped = hessian + damping * np.diag(np.diagonal(hessian))
    free, step = np.ones(len(gradient), dtype=np.bool_), np.zeros(len(gradient))
    while free.any():
        left = gradient[free] - damped[np.ix_(free, ~free)] @ step[~free]
        step[free] = np.linalg.solve(damped[np.ix_(free, free)], left)
        outside = np.flatnonzero(free & ((step < low) | (step > high)))
        if not len(outside):
            break
        ends = np.clip(step, low, high)
        first = outside[np.argmin(ends[outside] / step[outside])]
        step[first], free[first] = ends[first], False
    return step


def by_track(gram: Array, track: Index) -> Array:
    """(t, c, c) sums of inner products (n, c, c) over the stretches of each track."""
    names, index = np.unique(track, return_inverse=True)
    total = np.zeros((len(names), *gram.shape[1:]))
    np.add.at(total, index, gram)
    return total
