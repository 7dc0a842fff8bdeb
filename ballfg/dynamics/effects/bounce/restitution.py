"""Restitution: how much of the normal speed a bounce gives back."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import BounceEffect, Coefficient, Impact


class Restitution(BounceEffect):
    """v_n' = -e v_n with a constant e: 0.85 to 0.95 for a 40 mm ball on a table (docs/physics.md)."""

    name = "restitution"
    sentence = "Constant coefficient of restitution along the normal."
    decide = "Drop the ball without spin and compare the heights before and after several bounces."
    coefficients = (Coefficient("e", 0.93, 0.02, "1", 0.0, 1.0, varies=True, absent=1.0),)
    e: Tensor

    def adjust(self, impact: Impact) -> Impact:
        """The impact with e as its restitution."""
        return impact.with_(restitution=self.e)
