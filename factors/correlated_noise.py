"""Models a tracker's lasting errors as biases with a memory, and the jitter of its stamps.

A tracker's error is e_i = b_i + w_i + v_i s_i: a bias b with a memory (an Ornstein-Uhlenbeck process), a white error w,
and the ball's displacement at velocity v during the stamp's error s. The biases are unknowns of the graph, one per
state, so that the graph stays banded; b_{i+1} = a_i b_i + noise with a_i = exp(-dt_i / memory time).
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.deferred import torch
from ballfg.factors.batch import DiagonalFactors, FactorBatch, Noise, check_measured
from ballfg.factors.loss import Loss
from ballfg.factors.noise import whitening_tensor
from ballfg.state import POSITION, STATE_DIM

if TYPE_CHECKING:
    from torch import Tensor

BIAS_DIM = 3
_BIAS = slice(STATE_DIM, STATE_DIM + BIAS_DIM)


def bias_step(dt: Array, sigma: Array, memory_time: float) -> tuple[Array, Array]:
    """Decay of a bias over dt: b' = a b + noise, with a = exp(-dt / memory time).

    Args:
        dt: (m,) s.  sigma: (3,) m, standard deviation s of the bias per axis.
        memory_time: s, over which the bias falls to 1 / e.
    Returns: a (m,), dimensionless; the noise's standard deviations s sqrt(1 - a^2), (m, 3) m.
    """
    return np.exp(-dt / memory_time), sigma * np.sqrt(-np.expm1(-2.0 * dt / memory_time))[:, None]


class BiasedPositionFactors(FactorBatch):
    """r = W (p_i + b_i - z_i): a measured position is the state's position plus the tracker's bias plus noise.

    Args:
        states: (m,) indices of the observed states.  measured: (m, 3) m.
        sigma: (m, 3) m, standard deviation per axis of the white error.
        stamps: (m, 3, 3) m^2, covariance of the displacement by the stamps' errors; None if stamps are exact.
        loss: a robust one if tracks have outliers.  biased: True if the graph has biases; without them b is zero.

    Raises: ValueError: a wrong shape, or a position that is not finite.
    """

    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "measured", "sigma", "stamps", "information_root")

    def __init__(
        self,
        states: Index,
        measured: Array,
        sigma: Array,
        stamps: Array | None = None,
        loss: Loss | None = None,
        biased: bool = True,
    ) -> None:
        super().__init__(np.asarray(states)[:, None], 3, loss)
        check_measured(len(self), measured, sigma)
        self.measured, self.sigma = measured, sigma
        self.stamps = np.zeros((len(self), 3, 3)) if stamps is None else stamps
        covariance = sigma[:, :, None] ** 2 * np.eye(3) + self.stamps
        self.information_root = np.linalg.inv(np.linalg.cholesky(covariance))
        self.sees_biases = biased  # type: ignore[misc]  # the class's is that of factors that know states alone

    @property
    def group(self) -> Hashable:
        """Further entry of the group: whether the graph has biases."""
        return (*super().group, self.sees_biases)  # type: ignore[misc]

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 3) and Jacobians (k, 3, 9) or, with biases, (k, 3, 12)."""
        (state,), root = inputs, self.information_root[rows]
        error = state[:, POSITION] - self.measured[rows]
        jacobian = np.zeros((len(state), 3, state.shape[1]))
        jacobian[:, :, POSITION] = root
        if self.sees_biases:
            error += state[:, _BIAS]
            jacobian[:, :, _BIAS] = root
        return np.einsum("nij,nj->ni", root, error), (jacobian,)

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, 3) whitened residuals in torch."""
        error = inputs[0][:, POSITION] - torch.from_numpy(self.measured)
        if self.sees_biases:
            error = error + inputs[0][:, _BIAS]
        return (torch.from_numpy(self.information_root) @ error.unsqueeze(-1)).squeeze(-1)

    def noise_scale(self, noise: Noise) -> Tensor | None:
        """(m, 3, 3) from the present noise to one whose white part is scaled; errors of stamps stay as they are."""
        if noise.position is None:
            return None
        white = (noise.position * torch.from_numpy(self.sigma)).square().diag_embed()
        return whitening_tensor(white + torch.from_numpy(self.stamps)) @ torch.linalg.inv(
            torch.from_numpy(self.information_root)
        )

    def log_spread(self) -> float:
        """Half the log determinants of all covariances."""
        return -float(np.log(np.diagonal(self.information_root, axis1=1, axis2=2)).sum())


class BiasFactors(DiagonalFactors):
    """r = (b_{i+1} - a_i b_i) / (s sqrt(1 - a_i^2)), a_i = exp(-dt_i / memory time): the bias decays and is renewed.

    Args:
        states: (m,) index i; each factor ties the bias at state i to that at state i + 1.  dt: (m,) s.
        sigma: (3,) m, standard deviation s of the bias per axis.  memory_time: s, over which the bias falls to 1 / e.

    Raises: ValueError: if a dt, a sigma or the memory time is not positive.
    """

    sees_biases: ClassVar[bool] = True
    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "decay", "information_root")

    def __init__(self, states: Index, dt: Array, sigma: Array, memory_time: float) -> None:
        states = np.asarray(states, dtype=np.int64)
        super().__init__(np.stack((states, states + 1), axis=-1), BIAS_DIM)
        if not ((dt > 0).all() and (sigma > 0).all() and memory_time > 0.0):
            raise ValueError("dt, sigma and memory_time must be positive; sort the times and drop repeats")
        self.decay, spread = bias_step(dt, sigma, memory_time)
        self.information_root = 1.0 / spread

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 3) and Jacobians (k, 3, 12) twice."""
        before, after = inputs
        root, decay = self.information_root[rows], self.decay[rows, None]
        residual = root * (after[:, _BIAS] - decay * before[:, _BIAS])
        blocks = np.zeros((2, len(before), BIAS_DIM, before.shape[1]))
        axes = np.arange(BIAS_DIM)
        blocks[0][:, axes, STATE_DIM + axes], blocks[1][:, axes, STATE_DIM + axes] = -decay * root, root
        return residual, (blocks[0], blocks[1])

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, 3) whitened residuals in torch."""
        before, after = (state[:, _BIAS] for state in inputs)
        return torch.from_numpy(self.information_root) * (after - torch.from_numpy(self.decay)[:, None] * before)


class BiasStartFactors(DiagonalFactors):
    """r = b_i / s: the prior of the first bias, about zero.

    Args: states: (m,) indices of states without an earlier bias.  sigma: (3,) m, standard deviation s per axis.
    """

    sees_biases: ClassVar[bool] = True
    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "information_root")

    def __init__(self, states: Index, sigma: Array) -> None:
        super().__init__(np.asarray(states)[:, None], BIAS_DIM)
        self.information_root = np.broadcast_to(1.0 / sigma, (len(self), BIAS_DIM))

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 3) and Jacobians (k, 3, 12)."""
        root = self.information_root[rows]
        jacobian = np.zeros((len(root), BIAS_DIM, inputs[0].shape[1]))
        axes = np.arange(BIAS_DIM)
        jacobian[:, axes, STATE_DIM + axes] = root
        return root * inputs[0][:, _BIAS], (jacobian,)

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, 3) whitened residuals in torch."""
        return torch.from_numpy(self.information_root.copy()) * inputs[0][:, _BIAS]
