"""Linear factors keep the information of removed states and of a tracker's bias."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY
from ballfg.factors.correlated_noise import BIAS_DIM, BiasFactors, BiasStartFactors
from ballfg.state import STATE_DIM

if TYPE_CHECKING:
    import gtsam


def linear_factor(
    keys: Sequence[int], blocks: Sequence[Array], right: Array, point: "gtsam.Values | None" = None
) -> "gtsam.NonlinearFactor":
    """The factor r = sum A_k (x_k - p_k) - b of one or two states; being linear, it needs no callback from GTSAM.

    Args: blocks: (r, w) each, A_k whitened.  right: (r,) b, whitened.  point: p_k of all states; None: zero.
    """
    import gtsam

    parts: list[Any] = [part for pair in zip(keys, blocks, strict=False) for part in pair]
    parts += [right, gtsam.noiseModel.Unit.Create(len(right))]
    factor = gtsam.JacobianFactor(*parts)
    if point is None:
        point = gtsam.Values()
        for key, block in zip(keys, blocks, strict=True):
            point.insert(key, np.zeros(block.shape[1]))
    return gtsam.LinearContainerFactor(factor, point)


def linearized(factor: "gtsam.NonlinearFactor", point: "gtsam.Values") -> tuple[list[int], list[Array], Array]:
    """A factor about a point, whitened: its keys, a block (r, w) of each, and the right side (r,)."""
    keys = list(factor.keys())
    matrix, right = factor.linearize(point).jacobian()
    ends = np.cumsum([len(point.atVector(key)) for key in keys])
    return keys, np.split(matrix, ends[:-1], axis=1), right


def bias_start(key: int, settings: Settings) -> "gtsam.NonlinearFactor":
    """The prior of a state's bias, about zero."""
    return _of_biases(BiasStartFactors(np.array([key - STATE_KEY]), settings.bias_sigmas))


def bias_link(key: int, dt: float, settings: Settings) -> "gtsam.NonlinearFactor":
    """The factor between the biases of two states, dt s apart: the bias decays and is renewed."""
    before = np.array([key - STATE_KEY - 1])
    return _of_biases(BiasFactors(before, np.array([dt]), settings.bias_sigmas, settings.memory_time))


def _of_biases(batch: BiasStartFactors | BiasFactors) -> "gtsam.NonlinearFactor":
    """The single factor of a batch, on biases."""
    keys = [STATE_KEY + int(i) for i in batch.variables[0]]
    origin = np.zeros((1, STATE_DIM + BIAS_DIM))
    (residual,), blocks = batch.compute(slice(None), (origin,) * len(keys))
    return linear_factor(keys, [block[0] for block in blocks], -residual)


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

    @classmethod
    def of_gtsam(cls, factor: "gtsam.NonlinearFactor", values: Values, first: int) -> Self:
        """A linear factor of iSAM2 at the values of the window, whose first state has the number `first`."""
        import gtsam

        keys = list(factor.keys())
        numbers = [COEFFICIENTS if k == COEFFICIENT_KEY else k - STATE_KEY - first for k in keys]
        points = [np.array(values.gather(np.array([n]), with_biases=True)) for n in numbers]
        at = gtsam.Values()
        for key, point in zip(keys, points, strict=True):
            at.insert(key, point[0])
        _, blocks, b = linearized(factor, at)
        return cls(numbers, points, blocks, b, values.biases is not None)

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Residual (1, r) and Jacobians (1, r, d)."""
        parts = [block @ (x - at)[0] for block, x, at in zip(self.blocks, inputs, self.points, strict=True)]
        return (np.sum(parts, axis=0) - self.b)[None], tuple(block[None] for block in self.blocks)
