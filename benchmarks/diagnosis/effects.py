"""The planted effects: every catalogue effect at its typical size, pairs of them, and physics of no catalogue.

Typical sizes are those that docs/physics.md lists under what matters, or the nominal value of an effect that the
declared model is made to lack.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.search.hypothesis import Hypothesis
from ballfg.dynamics import EFFECTS


@dataclass(frozen=True)
class Plant:
    """An effect that acts although the declared model lacks it.

    Attributes:
        name: of the effect.
        amounts: by coefficient, what is added at size 1.
        base: value of those coefficients at size 0: the effect is absent, or as declared.
        left_out: the nominal model has it; the declared model is the nominal one without it.
        hidden: other effects or free coefficients do the same; an honest answer names one of those effects or says that
            it cannot be seen.
        sized: it comes in sizes; else it is there or not.
    """

    name: str
    amounts: tuple[tuple[str, float], ...]
    base: float = 0.0
    left_out: bool = False
    hidden: bool = False
    sized: bool = True

    def texts(self, size: float) -> tuple[str, ...]:
        """The effect at a size, 1 being typical, as a simulation reads it: `wind.x=0.2`."""
        return tuple(f"{self.name}.{c}={self.base + size * amount!r}" for c, amount in self.amounts)

    def hypothesis(self) -> Hypothesis:
        """The right one: this effect in its true shape."""
        coefficients = EFFECTS[self.name].coefficients
        if not self.sized:
            whole = {c.name: c.default for c in coefficients} | dict(self.amounts)
            return Hypothesis(EFFECTS[self.name], whole)
        shape = {c.name: c.default for c in coefficients if c.absent is None}
        return Hypothesis(EFFECTS[self.name], shape, tuple(c.name for c in coefficients if c.absent is not None))

    def direction(self) -> Array:
        """(p,) what size 1 adds to each strength of the hypothesis."""
        amounts = dict(self.amounts)
        return np.array([amounts.get(c, 0.0) for c in self.hypothesis().strengths])


PLANTS: Final[dict[str, Plant]] = {
    plant.name: plant
    for plant in (
        Plant("wind", (("x", 0.2),)),
        Plant("restitution_speed", (("slope", 0.02),)),
        Plant("frame_tilt", (("y", 0.0087),)),
        Plant("magnus", (("k", 0.0028),), left_out=True),
        Plant("drag_spin", (("gain", 0.3),)),
        Plant("spin_decay", (("rate", 0.2),)),
        Plant("time_offset", (("x", 0.002),)),
        Plant("spin_label_scale", (("s", 0.1),)),
        Plant("wind_shear", (("x", 0.5),)),
        Plant("gust_region", (("x", 1.0),)),
        Plant("drag", (("k", 0.12),), left_out=True),
        Plant("drag_speed", (("slope", 0.03),)),
        Plant("magnus_saturation", (("strength", 0.5),)),
        Plant("restitution", (("e", -0.07),), base=1.0, left_out=True),
        Plant("friction", (("mu", 0.25),), left_out=True),
        Plant("tangential_restitution", (("e_t", 0.15),), left_out=True),
        Plant("table_height", (("offset", -0.003),), left_out=True),
        Plant("table_tilt", (("y", 0.0087),)),
        Plant("scale", (("x", 0.01),)),
        Plant("radial_bias", (("offset", 0.01),)),
        Plant("distortion", (("k", 0.008),)),
        Plant("spin_label_offset", (("y", 15.0),)),
        Plant("spin_label_frame", (("yy", -1.0),), sized=False),
        Plant("gravity", (("g", 0.1),), base=9.81, hidden=True),
        Plant("buoyancy", (("a", 0.146),), hidden=True),
        Plant("time_scale", (("s", 0.01),), hidden=True),
        Plant("velocity_lag", (("lag", 0.003),), hidden=True),
    )
}
"""By name; the first ones serve for a quick look. Sizes: SI units."""

PAIRS: Final = (
    ("wind", "restitution_speed"),
    ("frame_tilt", "spin_decay"),
    ("magnus_saturation", "table_tilt"),
    ("drag_speed", "time_offset"),
    ("wind_shear", "spin_label_offset"),
)
"""Two at once, of typical sizes."""

UNKNOWN: Final[dict[str, tuple[tuple[str, ...], ...]]] = {
    "pull": (("pull.strength=1.0",),),
    "thick_air": (("thick_air.growth=0.5",),),
    "side_lean": (("side_lean.strength=0.3",),),
    "two_tables": ((), ("restitution.e=0.88", "table_height.offset=-0.011", "friction.mu=0.4")),
}
"""Physics that no catalogue holds: the undeclared effects of each session that a dataset consists of."""
