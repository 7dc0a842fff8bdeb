"""Linear factors keep the information of removed states."""

from collections.abc import Sequence

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.factors.batch import FactorBatch


class LinearFactors(FactorBatch):
    """One linear factor r = sum A_i (v_i - v_i*) - b, with the information of removed states.

    Args:
        numbers: of its variables v_i.  points: (1, d) each, v_i* in the variable's own units.
        blocks: (r, d) each, A_i whitened, per unit of the variable.  b: (r,) whitened.
        sees_biases: True if biases follow the states.
    """

    def __init__(
        self, numbers: Sequence[int], points: Sequence[Array], blocks: Sequence[Array], b: Array, sees_biases: bool
    ) -> None:
        super().__init__(np.array([numbers]), len(b))
        self.sees_biases = sees_biases  # type: ignore[misc]  # the class's is that of states alone
        self.points, self.blocks, self.b = tuple(points), tuple(blocks), b

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Residual (1, r) and Jacobians (1, r, d)."""
        parts = [block @ (x - at)[0] for block, x, at in zip(self.blocks, inputs, self.points, strict=True)]
        return (np.sum(parts, axis=0) - self.b)[None], tuple(block[None] for block in self.blocks)
