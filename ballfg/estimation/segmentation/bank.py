"""The hypotheses of a segmentation, as a struct of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.estimation.segmentation.events import Event, Node

FLYING = -1
"""Value of `Bank.surface` for a ball in the air."""

IntArray = NDArray[np.int64]


@dataclass(slots=True)
class Bank:
    """h hypotheses. The axes x, y, z are filtered independently; (p, v, b) are position, velocity and slack.

    Attributes:
        mean: (h, 3, 3) axis by (p m, v m/s, b m/s^2).
        cov: (h, 3, 3, 3) axis by covariance of (p, v, b).
        surface: (h,) index of the surface on which the ball rests, or `FLYING`.
        score: (h,) nats, log evidence less the prices of events; a constant per sample is left out.
        age: (h,) samples used since the last event.
        shift: (h, 3) m, by which the tracker is believed to be off; `mean` is what it sees, surfaces appear so moved.
        tips: (h,) the last `Node` of each hypothesis, or None.
    """

    mean: Array
    cov: Array
    surface: IntArray
    score: Array
    age: IntArray
    shift: Array
    tips: NDArray[np.object_]

    def __len__(self) -> int:
        return len(self.score)

    @property
    def resting(self) -> IntArray:
        """Rows of the hypotheses that rest on a surface."""
        return (self.surface != FLYING).nonzero()[0]

    @property
    def all_flying(self) -> bool:
        """Whether no hypothesis rests: quicker than `resting` for the few rows there are."""
        return self.surface.tolist() == [FLYING] * len(self)

    def take(self, rows: IntArray | list[int]) -> Bank:
        """A copy of some hypotheses."""
        return Bank(
            self.mean[rows],
            self.cov[rows],
            self.surface[rows],
            self.score[rows],
            self.age[rows],
            self.shift[rows],
            self.tips[rows],
        )

    def take_best(self) -> Bank:
        """A copy of the hypothesis with the highest score."""
        return self.take([int(self.score.argmax())])

    def add_event(self, row: int, event: Event) -> None:
        """Appends an event to the chain of one hypothesis."""
        self.tips[row] = Node(event, self.tips[row])


def concatenate(banks: Sequence[Bank]) -> Bank:
    """All hypotheses of some banks, in order."""
    if len(banks) == 1:
        return banks[0]
    return Bank(
        np.concatenate([b.mean for b in banks]),
        np.concatenate([b.cov for b in banks]),
        np.concatenate([b.surface for b in banks]),
        np.concatenate([b.score for b in banks]),
        np.concatenate([b.age for b in banks]),
        np.concatenate([b.shift for b in banks]),
        np.concatenate([b.tips for b in banks]),
    )
