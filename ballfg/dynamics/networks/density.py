"""Estimates how densely training tracks cover a network's features, as a weight from 0 to 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn

from ballfg.arrays import Array

MOST_CENTRES: Final = 200
"""Largest number of kernels: more cost time in every step of a flight and hardly change the density."""
LEAST_GROUPS: Final = 8  # Smallest number of tracks for a density; with fewer its weight is zero
LEAST_SPREAD: Final = 0.03  # Smallest spread of a feature in [-1, 1], for a launcher that always does the same
EDGE: Final = 0.05  # Share of held-out training features whose weight is below one half
BANDWIDTHS: Final = np.geomspace(0.05, 2.0, 30)  # Kernel widths to choose from, in standard deviations of the features


class FeatureDensity(nn.Module):
    """The weight p / (p + edge) of the density p of Gaussian kernels; without kernels it is zero everywhere.

    Attributes:
        centres: (c, f) features over their spreads.  spread: (f,) unit of each feature.
        width: () standard deviation of a kernel in these units.
        edge: () density at which the weight is one half; the peak of a kernel counts as one.
    """

    centres: Tensor
    spread: Tensor
    width: Tensor
    edge: Tensor

    def __init__(self, centres: int, features: int) -> None:
        super().__init__()
        self.register_buffer("centres", torch.zeros(centres, features, dtype=torch.float64))
        self.register_buffer("spread", torch.ones(features, dtype=torch.float64))
        self.register_buffer("width", torch.ones((), dtype=torch.float64))
        self.register_buffer("edge", torch.ones((), dtype=torch.float64))

    def forward(self, features: Tensor) -> Tensor:
        """Weights (..., 1) in [0, 1) of features (..., f), smooth in them."""
        if not len(self.centres):
            return features.new_zeros((*features.shape[:-1], 1))
        away = ((features / self.spread).unsqueeze(-2) - self.centres) / self.width
        density = torch.exp(-0.5 * away.square().sum(-1)).mean(-1, keepdim=True)
        weight: Tensor = density / (density + self.edge)
        return weight

    @classmethod
    def of(cls, groups: Sequence[Array], features: int) -> FeatureDensity:
        """The density of training features, with the kernel width that is most probable for held-out tracks.

        Every track counts the same, however many samples it has.

        Args: groups: (n, f) features of each track.  features: f.
        """
        groups = [group for group in groups if len(group)]
        if len(groups) < LEAST_GROUPS:
            return cls(0, features)
        each = max(1, MOST_CENTRES // len(groups))
        rows = [np.linspace(0, len(group) - 1, min(each, len(group))).round().astype(int) for group in groups]
        kept = np.concatenate([group[row] for group, row in zip(groups, rows, strict=True)])
        owner = np.repeat(np.arange(len(groups)), [len(row) for row in rows])
        spread = np.concatenate(groups).std(axis=0) + LEAST_SPREAD
        centres = kept / spread
        square = ((centres[:, None] - centres[None]) ** 2).sum(axis=-1)
        other = owner[:, None] != owner[None]
        densities = [np.where(other, np.exp(-0.5 * square / h**2), 0.0).sum(1) / other.sum(1) for h in BANDWIDTHS]
        scores = [
            np.log(density / h**features + 1e-12).mean() for density, h in zip(densities, BANDWIDTHS, strict=True)
        ]
        best = int(np.argmax(scores))
        density = cls(len(centres), features)
        density.centres = torch.from_numpy(centres)
        density.spread = torch.from_numpy(spread)
        density.width = torch.tensor(BANDWIDTHS[best], dtype=torch.float64)
        density.edge = torch.tensor(max(np.quantile(densities[best], EDGE), 1e-9), dtype=torch.float64)
        return density
