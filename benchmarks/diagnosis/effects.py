"""Lists the planted effects: every catalogue effect at its usual size, pairs, and physics of no catalogue.

Typical sizes are the effects' own usual ones.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.dynamics import EFFECTS, nominal_model


@dataclass(frozen=True)
class Plant:
    """An effect that acts although the declared model lacks it."""

    name: str  # of the effect
    amounts: tuple[tuple[str, float], ...]  # by coefficient, the addition at size 1
    base: float = 0.0  # value of those coefficients at size 0: the effect is absent, or as declared
    left_out: bool = False  # the nominal model has it; the declared model is the nominal one without it
    hidden: bool = False
    """Other effects or free coefficients do the same; an honest answer names one of those effects or says that it
    cannot be seen."""
    sized: bool = True  # it comes in sizes; else it is there or not

    def texts(self, size: float) -> tuple[str, ...]:
        """The effect at a size, 1 being typical, as a simulation reads it: `wind.x=0.2`."""
        return tuple(f"{self.name}.{c}={self.base + size * amount!r}" for c, amount in self.amounts)

    def hypothesis(self) -> Hypothesis:
        """The true hypothesis, with this effect in its true shape."""
        coefficients = EFFECTS[self.name].coefficients
        if not self.sized:
            whole = {c.name: c.default for c in coefficients} | {c: self.base + a for c, a in self.amounts}
            return Hypothesis(EFFECTS[self.name], whole)
        shape = {c.name: c.default for c in coefficients if c.absent is None}
        return Hypothesis(EFFECTS[self.name], shape, tuple(c.name for c in coefficients if c.absent is not None))

    def direction(self) -> Array:
        """(p,) what size 1 adds to each strength of the hypothesis."""
        amounts = dict(self.amounts)
        return np.array([amounts.get(c, 0.0) for c in self.hypothesis().strengths])


FIRST: Final = (
    "wind", "restitution_speed", "frame_tilt", "magnus", "drag_spin", "spin_decay", "time_offset", "spin_label_scale",
)  # fmt: skip
"""The effects that serve for a quick look."""


def _plants() -> Iterator[Plant]:
    """One for each effect whose usual strength is known; those for a quick look first."""
    nominal = nominal_model()
    for name in (*FIRST, *(name for name in EFFECTS if name not in FIRST)):
        effect = EFFECTS[name]
        if effect.usual is None:
            continue
        changed = next(c for c in effect.coefficients if c.name in effect.usual.change)
        base = changed.default if changed.sigma == 0.0 or changed.absent is None else changed.absent
        left_out = changed.sigma > 0.0 and (name in nominal.flight or name in nominal.bounce)
        yield Plant(name, tuple(effect.usual.change.items()), base, left_out, effect.imitated, effect.usual.graded)


PLANTS: Final[dict[str, Plant]] = {plant.name: plant for plant in _plants()}
"""By name, at the strengths that the effects call usual."""

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
