"""Makes linear factors of a tracker's bias for iSAM2, and moves a state with the bias behind it."""

from collections.abc import Sequence

import gtsam
import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.settings import Settings
from ballfg.factors.bridge import STATE_KEY
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
