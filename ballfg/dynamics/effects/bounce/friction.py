"""Friction between ball and surface, and the tangential restitution of a ball that grips."""

from torch import Tensor

from ballfg.dynamics.effect import BounceEffect, Coefficient, Impact


class Friction(BounceEffect):
    """The ball slides while friction cannot stop its slip, else it leaves rolling (Nakashima et al. 2010)."""

    name = "friction"
    sentence = "Coulomb friction in the contact; the ball slides or rolls."
    decide = (
        "Shoot fast and flat, so that the ball slides through the bounce: only then does friction set what it loses."
    )
    coefficients = (Coefficient("mu", 0.25, 0.05, "1", 0.0, 2.0),)
    mu: Tensor

    def adjust(self, impact: Impact) -> Impact:
        """The impact with mu as its friction coefficient."""
        return impact.with_(friction=self.mu)


class TangentialRestitution(BounceEffect):
    """A ball that grips leaves with the fraction e_t of its slip reversed, instead of rolling (e_t = 0).

    Source: R. Cross, "Grip-slip behavior of a bouncing ball", American Journal of Physics 70, 2002.
    """

    name = "tangential_restitution"
    sentence = "Tangential compliance of the contact: slip is partly reversed when the ball grips."
    decide = "Shoot slowly with much spin, so that the ball grips in the bounce, and measure the spin after it."
    coefficients = (Coefficient("e_t", 0.15, 0.1, "1", -1.0, 1.0),)
    e_t: Tensor

    def adjust(self, impact: Impact) -> Impact:
        """The impact with e_t as its tangential restitution."""
        return impact.with_(tangential_restitution=self.e_t)
