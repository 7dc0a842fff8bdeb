"""Generic contact: the ball bounces as if it came in with another velocity, for what nobody can name."""

from __future__ import annotations

from typing import Final

import torch

from ballfg.dynamics.effect import BounceEffect, Coefficient, Impact, vector

AXES: Final = ("x", "y", "z")
TERMS: Final = {
    "one": (0.1, "m/s"),
    "vx": (0.03, "1"),
    "vy": (0.03, "1"),
    "vz": (0.03, "1"),
    "wx": (0.001, "m"),
    "wy": (0.001, "m"),
    "wz": (0.001, "m"),
}
"""Terms in the incoming velocity and spin: standard deviation of the prior and unit; each worth about 0.1 m/s."""
BOUND: Final = 1e3
"""Of each coefficient, in units of its prior's standard deviation."""


class GenericContact(BounceEffect):
    """v + sum of c_{axis,term} term axis in place of the incoming velocity v, in the axes of the surface.

    What comes out changes by the impulse's derivative: by -e c vertically, by c less what friction takes horizontally.
    """

    name = "generic_contact"
    sentence = "A change of the bounce that is linear in the incoming velocity and spin; it names no cause."
    decide = "Let the ball bounce with one component of velocity or spin varied at a time."
    coefficients = tuple(
        Coefficient(f"{axis}_{term}", 0.0, sigma, unit, -BOUND * sigma, BOUND * sigma)
        for axis in AXES
        for term, (sigma, unit) in TERMS.items()
    )

    def adjust(self, impact: Impact) -> Impact:
        """The impact with another incoming velocity."""
        strengths = vector(*(getattr(self, c.name) for c in self.coefficients)).unflatten(-1, (3, -1))
        one = torch.ones_like(impact.velocity[..., :1])
        terms = torch.cat((one, impact.velocity, impact.spin), dim=-1)
        return impact.with_(velocity=impact.velocity + (strengths * terms.unsqueeze(-2)).sum(-1))
