"""Linear factors keep the information of removed states and of a tracker's bias."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import gtsam
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY
from ballfg.factors.correlated_noise import BIAS_DIM, BiasFactors, BiasStartFactors, bias_step
from ballfg.state import STATE_DIM

_UNIT3 = gtsam.noiseModel.Unit.Create(3)


def linear_factor(keys: Sequence[int], blocks: Sequence[Array], right: Array) -> gtsam.NonlinearFactor:
    """The factor r = sum A_k x_k - b of one or two states; being linear, it needs no callback from GTSAM.

    Args: keys: of the states.  blocks: (3, w) each, A_k whitened.  right: (3,) b, whitened.
    """
    if len(keys) == 1:
        factor = gtsam.JacobianFactor(keys[0], blocks[0], right, _UNIT3)
    else:
        factor = gtsam.JacobianFactor(keys[0], blocks[0], keys[1], blocks[1], right, _UNIT3)
    origin = gtsam.Values()
    for key, block in zip(keys, blocks, strict=True):
        origin.insert(key, np.zeros(block.shape[1]))
    return gtsam.LinearContainerFactor(factor, origin)


def bias_start(key: int, settings: Settings) -> gtsam.NonlinearFactor:
    """The prior of a state's bias, about zero."""
    return _of_biases(BiasStartFactors(np.array([key - STATE_KEY]), settings.bias_sigmas))


def bias_link(key: int, dt: float, settings: Settings) -> gtsam.NonlinearFactor:
    """The factor between the biases of two states, dt s apart: the bias decays and is renewed."""
    before = np.array([key - STATE_KEY - 1])
    return _of_biases(BiasFactors(before, np.array([dt]), settings.bias_sigmas, settings.memory_time))


def _of_biases(batch: BiasStartFactors | BiasFactors) -> gtsam.NonlinearFactor:
    """The single factor of a batch, on biases."""
    keys = [STATE_KEY + int(i) for i in batch.variables[0]]
    origin = np.zeros((1, STATE_DIM + BIAS_DIM))
    (residual,), blocks = batch.compute(slice(None), (origin,) * len(keys))
    return linear_factor(keys, [block[0] for block in blocks], -residual)


def carried_with_bias(
    piece: Array, covariance: Array, bias: Array, dt: float, settings: Settings
) -> tuple[Array, Array]:
    """The propagation from a state, its bias and the coefficients to the next state with its bias.

    Args:
        piece: (9, 1 + 9 + p) the propagated state and its Jacobian side by side.
        covariance: (9, 9) of the process noise.
        bias: (3,) m, at the linearisation point.
        dt: s.
        settings: with a memory.
    Returns: propagation and noise of state and bias: (12, 1 + 12 + p) and (12, 12).
    """
    width = STATE_DIM + BIAS_DIM
    decay, spread = bias_step(np.array([dt]), settings.bias_sigmas, settings.memory_time)
    carried, noise = np.zeros((width, piece.shape[1] + BIAS_DIM)), np.zeros((width, width))
    carried[:STATE_DIM, : 1 + STATE_DIM] = piece[:, : 1 + STATE_DIM]
    carried[:STATE_DIM, 1 + width :] = piece[:, 1 + STATE_DIM :]
    carried[STATE_DIM:, 0] = decay * bias
    carried[STATE_DIM:, 1 + STATE_DIM : 1 + width] = decay * np.eye(BIAS_DIM)
    noise[:STATE_DIM, :STATE_DIM], noise[STATE_DIM:, STATE_DIM:] = covariance, np.diag(spread[0] ** 2)
    return carried, noise


def without_bias(joint: Array, width: int) -> Array:
    """(9 + p, 9 + p) covariance of a state and the coefficients, from (w + p, w + p) with the bias between them."""
    if width == STATE_DIM:
        return joint
    kept = np.delete(np.arange(len(joint)), np.s_[STATE_DIM:width])
    return joint[np.ix_(kept, kept)]


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
