"""A launcher factor compares the first spin with the one that a launcher's settings give along the flight."""

from __future__ import annotations

from collections.abc import Hashable
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.deferred import torch
from ballfg.factors.batch import FactorBatch, Noise
from ballfg.factors.loss import Loss
from ballfg.state import SPIN, VELOCITY

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.networks.spin_embedding import SpinEmbedding


class LauncherSpinFactors(FactorBatch):
    """r = (w_i - spin(settings, v_i)) / sigma: the spin turns with the estimated velocity, not with a measured one.

    Args:
        states: (m,) indices of the states at which the ball leaves the launcher.
        settings: (m, k) of the launcher, in the launcher's own units.
        embedding: from settings to spin; its weights may be learned.  sigma: (m, 3) rad/s.
        loss: a robust one if some settings are wrong.

    Raises: ValueError: a wrong shape, or a sigma that is not positive.
    """

    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "settings", "sigma")

    def __init__(
        self, states: Index, settings: Array, embedding: SpinEmbedding, sigma: Array, loss: Loss | None = None
    ) -> None:
        super().__init__(states[:, None], 3, loss)
        if settings.shape != (len(self), len(embedding.names)) or sigma.shape != (len(self), 3):
            raise ValueError(
                f"settings and sigma must have shapes ({len(self)}, {len(embedding.names)}) and ({len(self)}, 3); "
                f"got {settings.shape} and {sigma.shape}"
            )
        if not (sigma > 0).all():
            raise ValueError(f"sigma must be positive; got {sigma.min():g}. Leave out settings that say nothing.")
        self.settings = settings
        self.sigma = sigma
        self.embedding = embedding

    @property
    def group(self) -> Hashable:
        """Further entry of the group: the embedding."""
        return (*super().group, id(self.embedding))  # type: ignore[misc]

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 3) and Jacobians (k, 3, 9)."""
        from ballfg.dynamics.motion.integrate import batch_jacobian

        settings, sigma = torch.from_numpy(self.settings[rows]), torch.from_numpy(self.sigma[rows])
        function = partial(_whitened, self.embedding, settings, sigma)
        residual, jacobian = batch_jacobian(function, torch.from_numpy(inputs[0]), outputs=3)
        return residual.numpy(), (jacobian.numpy(),)

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, 3) whitened residuals in torch, differentiable in the embedding too."""
        return _whitened(self.embedding, torch.from_numpy(self.settings), torch.from_numpy(self.sigma), inputs[0])

    def noise_scale(self, noise: Noise) -> Tensor | None:
        """One factor for all axes of all spins."""
        return None if noise.spin is None else 1.0 / noise.spin

    def log_spread(self) -> float:
        """Sum of the logarithms of all standard deviations."""
        return float(np.log(self.sigma).sum())


def _whitened(embedding: SpinEmbedding, settings: Tensor, sigma: Tensor, state: Tensor) -> Tensor:
    return (state[..., SPIN] - embedding.spin(settings, state[..., VELOCITY])) / sigma
