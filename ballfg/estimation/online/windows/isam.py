"""Sets up the iSAM2 of a window and makes its linear factors, which keep what is known of removed states and biases."""

from collections.abc import Iterable, Sequence
from typing import Any

import gtsam
import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.windows.linear import LinearFactors
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import COEFFICIENTS, Values
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY
from ballfg.factors.correlated_noise import BIAS_DIM, BiasFactors, BiasStartFactors
from ballfg.state import STATE_DIM

WILDFIRE = 1e-7
"""m, m/s, rad/s. Back-substitution stops where the solution changes by less."""


def key_list(keys: Iterable[int]) -> gtsam.KeyList:
    """Keys as GTSAM takes them."""
    found = gtsam.KeyList()
    for key in keys:
        found.push_back(key)
    return found


def parameters(threshold: Array, coefficient_threshold: Array) -> gtsam.ISAM2Params:
    """QR, because a loose spin prior beside a tight process noise defeats Cholesky."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", threshold))
    if len(coefficient_threshold):
        thresholds.insert(("c", coefficient_threshold))
    parameters.setRelinearizeThreshold(thresholds)
    solver = gtsam.ISAM2GaussNewtonParams()
    solver.setWildfireThreshold(WILDFIRE)
    parameters.setOptimizationParams(solver)
    return parameters


def linear_factor(
    keys: Sequence[int], blocks: Sequence[Array], right: Array, point: gtsam.Values | None = None
) -> gtsam.NonlinearFactor:
    """The factor r = sum A_k (x_k - p_k) - b of one or two states; being linear, it needs no callback from GTSAM.

    Args: blocks: (r, w) each, A_k whitened.  right: (r,) b, whitened.  point: p_k of all states; None: zero.
    """
    parts: list[Any] = [part for pair in zip(keys, blocks, strict=False) for part in pair]
    parts += [right, gtsam.noiseModel.Unit.Create(len(right))]
    factor = gtsam.JacobianFactor(*parts)
    if point is None:
        point = gtsam.Values()
        for key, block in zip(keys, blocks, strict=True):
            point.insert(key, np.zeros(block.shape[1]))
    return gtsam.LinearContainerFactor(factor, point)


def linearized(factor: gtsam.NonlinearFactor, point: gtsam.Values) -> tuple[list[int], list[Array], Array]:
    """A factor about a point, whitened: its keys, a block (r, w) of each, and the right side (r,)."""
    keys = list(factor.keys())
    matrix, right = factor.linearize(point).jacobian()
    ends = np.cumsum([len(point.atVector(key)) for key in keys])
    return keys, np.split(matrix, ends[:-1], axis=1), right


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


def summary_of(factor: gtsam.NonlinearFactor, values: Values, first: int) -> LinearFactors:
    """A linear factor of iSAM2 at the values of the window, whose first state has the number `first`."""
    keys, at = list(factor.keys()), gtsam.Values()
    numbers = [COEFFICIENTS if k == COEFFICIENT_KEY else k - STATE_KEY - first for k in keys]
    points = [np.array(values.gather(np.array([n]), with_biases=True)) for n in numbers]
    for key, point in zip(keys, points, strict=True):
        at.insert(key, point[0])
    _, blocks, b = linearized(factor, at)
    return LinearFactors(numbers, points, blocks, b, values.biases is not None)
