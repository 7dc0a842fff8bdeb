"""Restitution that falls with the speed of the impact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from ballfg.dynamics.effect import BounceEffect, Coefficient, Impact
from ballfg.dynamics.scene import Scene


class RestitutionSpeed(BounceEffect):
    """e - slope (|v_n| - reference) in place of the declared e, kept within 0 and 1."""

    name = "restitution_speed"
    sentence = (
        "The coefficient of restitution falls with the normal speed of the impact; another reference is the same as "
        "another restitution."
    )
    decide = "Drop the ball from very different heights and compare the ratios of the heights after and before."
    coefficients = (
        Coefficient("slope", 0.0, 0.02, "s/m", -0.2, 0.2),
        Coefficient("reference", 3.0, 0.0, "m/s", 0.0, 20.0, absent=None),
    )
    needs = ("restitution",)
    slope: Tensor
    reference: Tensor

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """The reference in the middle of the data."""
        return ({"reference": scene.impact_speed},) if scene.contacts else ()

    def adjust(self, impact: Impact) -> Impact:
        """The impact with a restitution that depends on its normal speed."""
        e = impact.restitution - self.slope * (impact.normal_speed - self.reference)
        return impact.with_(restitution=e.clamp(0.0, 1.0))
