"""A position factor compares a measured position with the state's."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.deferred import torch
from ballfg.factors.batch import DiagonalFactors, Noise, check_measured
from ballfg.factors.loss import Loss
from ballfg.state import POSITION, STATE_DIM

if TYPE_CHECKING:
    from torch import Tensor


class PositionFactors(DiagonalFactors):
    """r = (p_i - z_i) / sigma_i.

    Args:
        states: (m,) indices of the observed states.
        measured: (m, 3) m.
        sigma: (m, 3) m, standard deviation per axis.
        loss: a robust one if tracks have outliers.

    Raises: ValueError: a wrong shape, a position that is not finite, or a sigma that is not positive.
    """

    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "measured", "information_root", "_jacobian")

    def __init__(self, states: Index, measured: Array, sigma: Array, loss: Loss | None = None) -> None:
        super().__init__(np.asarray(states)[:, None], 3, loss)
        check_measured(len(self), measured, sigma)
        self.measured = measured
        self.information_root = 1.0 / sigma
        self._jacobian = np.zeros((len(self), 3, STATE_DIM))
        self._jacobian[:, [0, 1, 2], [0, 1, 2]] = self.information_root

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 3) and Jacobians (k, 3, 9)."""
        residual = (inputs[0][:, POSITION] - self.measured[rows]) * self.information_root[rows]
        return residual, (self._jacobian[rows],)

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, 3) whitened residuals in torch."""
        return (inputs[0][:, POSITION] - torch.from_numpy(self.measured)) * torch.from_numpy(self.information_root)

    def noise_scale(self, noise: Noise) -> Tensor | None:
        """One factor for all axes of all samples."""
        return None if noise.position is None else 1.0 / noise.position
