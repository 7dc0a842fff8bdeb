"""Defines the interface of a sequence model, which predicts the rest of tracks from their observed part."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ballfg.learning.sequence.data import Batch
from ballfg.learning.sequence.frame import ROUND, Frame

Draw = tuple[int, int, int]
"""Seed, epoch and track, from which the random numbers of one track's loss derive."""


class SequenceModel(nn.Module, ABC):
    """A network with the frame it works in. Networks compute in float32, positions outside are float64.

    It is made from the number of the launcher's settings, that of the grid's points, and a width. No track's result
    depends on the others in its batch, beyond rounding.

    Attributes:
        frame: scales and grid.
        points: number of grid points that are predicted.
    """

    frame: Frame
    points: int

    @abstractmethod
    def losses(self, batch: Batch, draws: Sequence[Draw]) -> tuple[Tensor, Tensor]:
        """The losses of a batch.

        Returns: (losses, positions): (b,) differentiable, in squared units of the frame; (b, m, 3) m, the rest as
            predicted in training, without gradient.
        """

    @abstractmethod
    def predict(self, batch: Batch) -> Tensor:
        """(b, m, 3) m, world positions at the batch's times. The same batch gives the same bytes."""

    def points_asked(self, batch: Batch) -> int:
        """Number of grid points up to the last requested time, `points` at most."""
        return max(1, min(self.points, math.ceil(float(batch.times.max() / self.frame.step) - ROUND)))

    def path(self, grid: Tensor, batch: Batch) -> Tensor:
        """World positions (b, m, 3) m at the times asked, from local positions (b, p, 3) on the grid's first points."""
        start = self.frame.inward(batch.last_observed[:, None], batch)
        return self.frame.outward(self.frame.at_times(torch.cat([start, grid.double()], dim=1), batch.times), batch)
