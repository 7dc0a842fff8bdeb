"""What a measurement effect is: what is written down differs from what happened, the ball's motion stays as it is."""

from collections.abc import Callable
from typing import ClassVar

from torch import Tensor

from ballfg.dynamics.effect import Effect, Kind, Owner
from ballfg.state import POSITION

Later = Callable[[Tensor], Tensor]
"""The true motion: a delay in s, scalar or (...), not negative, to the true states (..., 9) that much later."""


class MeasurementEffect(Effect):
    """An effect on positions, stamps or spin labels. It overrides what it changes; the rest is written as it is.

    Attributes:
        rank: effects of a model act in the order of their ranks, those of one rank in that of their names. Below 10:
            may use `later`. 10 to 99: positions only. From 100 on: stamps and labels.
    """

    kind: ClassVar[Kind] = "measurement"
    belongs_to: ClassVar[Owner] = "rig"
    rank: ClassVar[int] = 99

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, the positions as they are measured, before noise.

        Args:
            states: (..., 9) true states, their positions those that the effect before this one measures.
            later: the true motion from the true states on.
        """
        return states[..., POSITION]

    def true_stamps(self, stamps: Tensor) -> Tensor:
        """(...) s of true time since the first stamp of a track, from the time written since then.

        Coefficients of shape (n, 1) go with stamps of shape (..., n, 1).
        """
        return stamps

    def stamps(self, times: Tensor) -> Tensor:
        """(...) s as written since the first stamp of a track, from true times (...) s; undoes `true_stamps`."""
        return times

    def label(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as a label says, from the true spin (..., 3) rad/s; affine in it."""
        return spin
