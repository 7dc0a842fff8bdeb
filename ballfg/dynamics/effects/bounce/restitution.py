"""Restitution: the share of the normal speed that a bounce gives back, constant or falling with the speed."""

from collections.abc import Mapping, Sequence

from torch import Tensor

from ballfg.dynamics.effect import BounceEffect, Coefficient, Impact
from ballfg.dynamics.scene import Scene


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
