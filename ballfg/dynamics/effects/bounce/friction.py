"""Coulomb friction between ball and surface during a bounce."""

from __future__ import annotations

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
