"""A measurement effect changes the recorded data, while the motion of the ball stays the same."""

from collections.abc import Callable
from typing import ClassVar

from torch import Tensor

from ballfg.dynamics.effect import Effect, Kind, Owner
from ballfg.state import POSITION

Later = Callable[[Tensor], Tensor]
"""The true motion: a delay in s, scalar or (...), not negative, to the true states (..., 9) that much later."""


class MeasurementEffect(Effect):
    """An effect on positions, stamps or spin labels. A subclass overrides the methods of what it changes.

    Attributes:
        rank: effects of a model act in the order of their ranks, then of their names. Effects below rank 10 may use
            `later`. 10 to 99: positions only. From 100 on: stamps and labels.
    """

    kind: ClassVar[Kind] = "measurement"
    belongs_to: ClassVar[Owner] = "rig"
    rank: ClassVar[int] = 99

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, the positions as they are measured, before noise.

        Args:
            states: (..., 9) true states, with positions as the previous effect measures them.
            later: the true motion from the true states on.
        """
        return states[..., POSITION]

    def true_stamps(self, stamps: Tensor) -> Tensor:
        """(...) s of true time since the first stamp of a track, from the recorded time.

        Coefficients of shape (n, 1) go with stamps of shape (..., n, 1).
        """
        return stamps

    def stamps(self, times: Tensor) -> Tensor:
        """(...) s of recorded time since the first stamp of a track, from true times (...) s; undoes `true_stamps`."""
        return times

    def label(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s, the spin that a label states, from the true spin (..., 3) rad/s; affine in it."""
        return spin
