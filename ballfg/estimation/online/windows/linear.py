"""A linear factor keeps the information of removed states on the first state that stays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import gtsam
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY


class LinearFactors(FactorBatch):
    """One linear factor r = sum A_i (v_i - v_i*) - b.

    Args:
        numbers: of its variables v_i.
        points: (1, d) each, v_i* in the variable's own units.
        blocks: (r, d) each, A_i whitened, per unit of the variable.
        b: (r,) whitened.
        sees_biases: True if biases follow the states.
    """

    def __init__(
        self, numbers: Sequence[int], points: Sequence[Array], blocks: Sequence[Array], b: Array, sees_biases: bool
    ) -> None:
        super().__init__(np.array([numbers]), len(b))
        self.sees_biases = sees_biases  # type: ignore[misc]  # the class's is that of states alone
        self.points, self.blocks, self.b = tuple(points), tuple(blocks), b

    @classmethod
    def of_gtsam(cls, factor: gtsam.NonlinearFactor, values: Values, first: int) -> Self:
        """A linear factor of iSAM2.

        Args: values: v*, of the window.  first: number of the window's first state.
        """
        keys = list(factor.keys())
        numbers = [COEFFICIENTS if k == COEFFICIENT_KEY else k - STATE_KEY - first for k in keys]
        points = [np.array(values.gather(np.array([n]), with_biases=True)) for n in numbers]
        at = gtsam.Values()
        for key, point in zip(keys, points, strict=True):
            at.insert(key, point[0])
        matrix, b = factor.linearize(at).jacobian()
        blocks = np.split(matrix, np.cumsum([point.shape[1] for point in points])[:-1], axis=1)
        return cls(numbers, points, blocks, b, values.biases is not None)

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Residual (1, r) and Jacobians (1, r, d)."""
        parts = [block @ (x - at)[0] for block, x, at in zip(self.blocks, inputs, self.points, strict=True)]
        return (np.sum(parts, axis=0) - self.b)[None], tuple(block[None] for block in self.blocks)
