"""Defines the effects on the impact and on the surfaces: restitution, friction, the table's height and tilt."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ballfg.dynamics.effect import (
    SEEN,
    TINY_LENGTH,
    BounceEffect,
    Coefficient,
    Impact,
    Range,
    Scene,
    Usual,
    length,
    vector,
)


class Restitution(BounceEffect):
    """v_n' = -e v_n with a constant e: 0.85 to 0.95 for a 40 mm ball on a table (docs/physics.md)."""

    name = "restitution"
    plain = "a bounce that loses speed"
    says = "The ball leaves the table with {e:%} of its vertical speed."
    sentence = "Constant coefficient of restitution along the normal."
    decide = "Drop the ball without spin and compare the heights before and after several bounces."
    coefficients = (Coefficient("e", 0.93, 0.02, "1", 0.0, 1.0, varies=True, absent=1.0),)
    plausible = Range(0.6, 1.0, "tables of the ITTF: 0.87 to 0.93; a mat or a floor less")
    usual = Usual({"e": -0.07}, "measured sets, docs/physics.md")

    def adjust(self, impact: Impact) -> Impact:
        """The impact with e as its restitution."""
        return impact.with_(restitution=self.e)


class Friction(BounceEffect):
    """The ball slides while friction cannot stop its slip, else it leaves rolling (Nakashima et al. 2010)."""

    name = "friction"
    plain = "friction at the bounce"
    says = "The table rubs on the ball (friction {mu:.2g})."
    sentence = "Coulomb friction in the contact; the ball slides or rolls."
    decide = (
        "Shoot fast and flat, so that the ball slides through the bounce: only then does friction set what it loses."
    )
    coefficients = (Coefficient("mu", 0.25, 0.05, "1", 0.0, 2.0),)
    plausible = Range(0.02, 1.0, "tables have 0.25 to 0.3, rubbers up to 1")
    usual = Usual({"mu": 0.25}, "Nakashima 2010; Hayakawa 2016")

    def adjust(self, impact: Impact) -> Impact:
        """The impact with mu as its friction coefficient."""
        return impact.with_(friction=self.mu)


class TangentialRestitution(BounceEffect):
    """A ball that grips leaves with the fraction e_t of its slip reversed, instead of rolling (e_t = 0).

    Source: R. Cross, "Grip-slip behavior of a bouncing ball", American Journal of Physics 70, 2002.
    """

    name = "tangential_restitution"
    plain = "a grip at the bounce that springs back"
    says = "The table grips the ball and throws back {e_t:%} of its slip."
    sentence = "Tangential compliance of the contact: slip is partly reversed when the ball grips."
    decide = "Shoot slowly with much spin, so that the ball grips in the bounce, and measure the spin after it."
    coefficients = (Coefficient("e_t", 0.15, 0.1, "1", -1.0, 1.0),)
    plausible = Range(0.0, 1.0, "none of the slip is reversed, or all of it; Cross 2002")
    usual = Usual({"e_t": 0.15}, "Cross 2002; measured sets, docs/physics.md")

    def adjust(self, impact: Impact) -> Impact:
        """The impact with e_t as its tangential restitution."""
        return impact.with_(tangential_restitution=self.e_t)


class TableHeight(BounceEffect):
    """Surfaces lie `offset` above their declared height.

    In measured tracks the bounce lies 2 to 4 mm lower than a rigid ball on the declared table would (docs/physics.md):
    calibration, and the ball's compression during a contact of about 1 ms.
    """

    name = "table_height"
    plain = "a table at another height"
    says = "The table is {offset:milli} mm {offset:higher|lower} than the dataset says."
    belongs_to = "room"
    sentence = "Surfaces lie higher or lower than declared."
    decide = "Lay the ball on the table and measure its position; vary the steepness of the impacts."
    coefficients = (Coefficient("offset", 0.0, 0.004, "m", -0.2, 0.2, varies=True),)
    plausible = Range(-0.03, 0.03, SEEN)
    usual = Usual({"offset": -0.003}, "balls of the measured sets bounce 2 to 4 mm lower")

    def surface_offset(self, position: Tensor) -> Tensor:
        """() or (..., 1) m."""
        return self.offset


class RestitutionSpeed(BounceEffect):
    """e - slope (|v_n| - reference) in place of the declared e, kept within 0 and 1."""

    name = "restitution_speed"
    plain = "a bounce that depends on the impact's speed"
    says = (
        "Faster impacts bounce {slope:less|more}: the share of vertical speed that is kept {slope:falls|grows} by "
        "{slope:points} points for each m/s."
    )
    sentence = (
        "The coefficient of restitution falls with the normal speed of the impact; another reference is the same as "
        "another restitution."
    )
    decide = "Drop the ball from very different heights and compare the ratios of the heights after and before."
    coefficients = (
        Coefficient("slope", 0.0, 0.02, "s/m", -0.2, 0.2),
        Coefficient("reference", 3.0, 0.0, "m/s", 0.0, 20.0, absent=None),
    )
    plausible = Range(-0.02, 0.06, "Nakashima 2010: 0.93 falls to 0.85 over 5 m/s")
    usual = Usual({"slope": 0.02}, "Nakashima 2010: 0.93 falls to 0.85 over 5 m/s")
    needs = ("restitution",)

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """The reference in the middle of the data."""
        return ({"reference": scene.impact_speed},) if scene.contacts else ()

    def adjust(self, impact: Impact) -> Impact:
        """The impact with a restitution that depends on its normal speed."""
        e = impact.restitution - self.slope * (impact.normal_speed - self.reference)
        return impact.with_(restitution=e.clamp(0.0, 1.0))


class TableTilt(BounceEffect):
    """Surfaces turned by the rotation vector (x, y, 0) about the point at their declared height over the origin.

    The plane through that point has the normal exp((x, y, 0)) z and the slope (-y, x) tan(angle) / angle. A ball
    touches it where its centre is one radius away from it, and bounces along its normal.
    """

    name = "table_tilt"
    plain = "a table that is not level"
    says = "The table is not level: it leans by {degrees}."
    belongs_to = "room"
    sentence = (
        "The table is not level: bounces lean to one side; over one place of impact its height is the same as that of "
        "the table."
    )
    decide = "Put a level on the table, or bounce the ball in several places: a tilted frame bends flights too."
    coefficients = tuple(Coefficient(axis, 0.0, 0.005, "rad", -0.3, 0.3) for axis in "xy")
    plausible = Range(-0.03, 0.03, "a table that leans by more lets a ball roll off")
    usual = Usual({"y": 0.0087}, "an estimate: half a degree, 24 mm over a table's length")

    def surface_offset(self, position: Tensor) -> Tensor:
        """(..., 1) m, the plane's height below the ball less that over the origin."""
        return (self.surface_slope(position) * position[..., :2]).sum(-1, keepdim=True)

    def surface_slope(self, position: Tensor) -> Tensor:
        """(2,) or (..., 2), the same everywhere."""
        angle = length(vector(self.x, self.y)).clamp_min(TINY_LENGTH)
        return (torch.tan(angle) / angle) * vector(-self.y, self.x)
