"""The effects a model file may name: one line for each. docs/add_an_effect.md shows how to add one."""

from __future__ import annotations

from typing import Final

from ballfg.dynamics.effect import BounceEffect, Effect, FlightEffect
from ballfg.dynamics.effects.drag import Drag
from ballfg.dynamics.effects.friction import Friction
from ballfg.dynamics.effects.gravity import Gravity
from ballfg.dynamics.effects.magnus import Magnus
from ballfg.dynamics.effects.restitution import Restitution
from ballfg.dynamics.effects.spin_decay import SpinDecay
from ballfg.dynamics.effects.table_height import TableHeight
from ballfg.dynamics.effects.tangential_restitution import TangentialRestitution

EFFECTS: Final[dict[str, type[Effect]]] = {
    effect.name: effect
    for effect in (
        Gravity,
        Drag,
        Magnus,
        SpinDecay,
        Restitution,
        Friction,
        TangentialRestitution,
        TableHeight,
    )
}


def effect_class(name: str, kind: str) -> type[Effect]:
    """The class of the effect `name` of a kind, `flight` or `bounce`.

    Raises: ValueError: if there is no such effect of that kind; the message lists those there are.
    """
    effect = EFFECTS.get(name)
    if effect is None or effect.kind != kind:
        known = ", ".join(n for n, e in EFFECTS.items() if e.kind == kind) or "none"
        raise ValueError(f"there is no {kind} effect '{name}'; known ones: {known}")
    return effect


__all__ = ["EFFECTS", "BounceEffect", "FlightEffect", "effect_class"]
