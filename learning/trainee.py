"""The contract between what is trained and the loop that trains it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn


@dataclass(frozen=True)
class BatchLoss:
    """What one batch of tracks gives. Everything is a sum over tracks, so that shards of a batch can be added.

    Attributes:
        total: () differentiable sum of the tracks' losses; 0 without a graph where every track failed.
        tracks: how many tracks are in it.
        squared_error: m^2, summed over `points` positions (three coordinates each).
        points: number of positions.
        failed: name and reason of each track that was left out.
    """

    total: Tensor
    tracks: int
    squared_error: float
    points: int
    failed: tuple[tuple[str, str], ...] = ()


class Trainee(ABC):
    """A model with its data: what a loop can take gradients of and judge.

    Tracks are numbered; a loop shards the numbers over processes. Nothing here may depend on how tracks are batched,
    beyond rounding.

    Attributes:
        module: holds every trainable parameter by name.
    """

    module: nn.Module

    @abstractmethod
    def loss(self, tracks: Sequence[int], epoch: int) -> BatchLoss:
        """The loss on some tracks of the training part; randomness is drawn from the seed, the track and the epoch."""

    @abstractmethod
    def judge(self, tracks: Sequence[int]) -> BatchLoss:
        """The same without gradient and augmentation, on tracks of any part."""

    def groups(self) -> list[dict[str, Any]]:
        """Parameter groups for a torch optimizer, each with `name` and a `scale` on the learning rate."""
        return [{"name": "all", "params": list(self.module.parameters()), "scale": 1.0}]

    def after_step(self) -> None:  # noqa: B027 - most models have no bounds
        """Bring parameters back into their bounds after an optimizer's step; none by default."""

    def memory(self) -> dict[str, Tensor]:
        """What, beside parameters, an uninterrupted run carries from one epoch to the next: warm starts. By name."""
        return {}

    def remember(self, memory: dict[str, Tensor]) -> None:
        """Take up what `memory` gave.

        Raises: ValueError: if it is another run's.
        """
        if memory:
            raise ValueError(f"memory must be empty for this model; got {', '.join(sorted(memory))}.")
