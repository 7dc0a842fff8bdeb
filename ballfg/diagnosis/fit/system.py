"""The linearised problem of all stretches, with the first states eliminated stretch by stretch.

Columns are whatever acts on all stretches: declared coefficients, mean spins of launcher groups, candidate effects, and
the residual itself. What is left of a column once the best first state has absorbed its part is its projected
signature; inner products of projected signatures, summed over each track, are all that tests and fits need.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.state import STATE_DIM

Array = NDArray[np.float64]


@dataclass(frozen=True)
class System:
    """Whitened rows of n stretches: m samples' coordinates and three of the spin each.

    Attributes:
        residual: (n, m) measured minus predicted.
        by_start: (n, m, 9) derivative of the prediction by the first state.
        by_common: (n, m, q) the same by what all stretches share.
    """

    residual: Array
    by_start: Array
    by_common: Array

    def eliminated(self, damping: float = 0.0) -> Eliminated:
        """The first states solved for in terms of everything else; `damping` as in Levenberg-Marquardt."""
        transposed = self.by_start.swapaxes(-1, -2)
        hessian = transposed @ self.by_start
        diagonal = np.arange(STATE_DIM)
        hessian[:, diagonal, diagonal] *= 1.0 + damping
        columns = np.concatenate((self.by_common, self.residual[..., None]), axis=-1)
        pulled = transposed @ columns
        solved = np.linalg.solve(hessian, pulled)
        gram = columns.swapaxes(-1, -2) @ columns - pulled.swapaxes(-1, -2) @ solved
        return Eliminated(np.asarray(solved), np.asarray(gram))

    def start_correction(self, residual: Array) -> Array:
        """(n, 9) step of the first states alone against another residual (n, m): derivatives stay as they are."""
        transposed = self.by_start.swapaxes(-1, -2)
        step = np.linalg.solve(transposed @ self.by_start, transposed @ residual[..., None])
        return np.asarray(step[..., 0])

    def projected(self) -> Array:
        """(n, m, q + 1) what first states leave of each column, the residual last."""
        transposed = self.by_start.swapaxes(-1, -2)
        columns = np.concatenate((self.by_common, self.residual[..., None]), axis=-1)
        return np.asarray(columns - self.by_start @ np.linalg.solve(transposed @ self.by_start, transposed @ columns))


@dataclass(frozen=True)
class Eliminated:
    """What is left once first states are solved for.

    Attributes:
        solved: (n, 9, q + 1) first states that absorb each column, the residual last.
        gram: (n, q + 1, q + 1) inner products of projected columns, the residual last.
    """

    solved: Array
    gram: Array

    def common_step(self, precision: Array, pull: Array, damping: float = 0.0) -> Array:
        """(q,) step of what is shared.

        Args: precision: (q,) of the priors.  pull: (q,) prior mean minus present value, times the precision.
        """
        total = self.gram.sum(axis=0)
        hessian = total[:-1, :-1] + np.diag(precision)
        hessian[np.diag_indices_from(hessian)] *= 1.0 + damping
        return np.asarray(np.linalg.solve(hessian, total[:-1, -1] + pull))

    def start_step(self, common: Array) -> Array:
        """(n, 9) step of the first states that goes with a step (q,) of what is shared."""
        return np.asarray(self.solved[..., -1] - self.solved[..., :-1] @ common)


def by_track(gram: Array, track: NDArray[np.int64]) -> Array:
    """(t, c, c) sums of inner products (n, c, c) over the stretches of each track."""
    names, index = np.unique(track, return_inverse=True)
    total = np.zeros((len(names), *gram.shape[1:]))
    np.add.at(total, index, gram)
    return total
