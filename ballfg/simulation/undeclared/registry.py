"""The effects that a simulation can switch on behind a model's back, and the text form `wind.x=0.3`."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.registry import EFFECTS
from ballfg.simulation.undeclared.pull import Pull
from ballfg.simulation.undeclared.side_lean import SideLean
from ballfg.simulation.undeclared.thick_air import ThickAir

NOWHERE: Final[dict[str, type[Effect]]] = {effect.name: effect for effect in (Pull, ThickAir, SideLean)}
"""Effects that no model file can declare."""


class _Undeclared(Mapping[str, type[Effect]]):
    """Registered effects, those registered later too; behind them those that no model file can declare."""

    def __getitem__(self, name: str) -> type[Effect]:
        return NOWHERE[name] if name in NOWHERE else EFFECTS[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**EFFECTS, **NOWHERE})

    def __len__(self) -> int:
        return len({**EFFECTS, **NOWHERE})


UNDECLARED: Final = _Undeclared()
"""Every effect by name. What a model file may declare can be left undeclared: an effect
that the model lacks (wind), or another value of one that it has (restitution.e)."""


def parse_effects(texts: Iterable[str]) -> tuple[Effect, ...]:
    """Effects from texts such as `wind.x=0.3`; coefficients that are not named keep their defaults.

    Raises: ValueError: a text of another form, an unknown effect or coefficient (the message names the nearest one),
        a coefficient given twice, or a value out of bounds.
    """
    values: dict[str, dict[str, float]] = {}
    for text in texts:
        effect, coefficient, value = _parse(text)
        given = values.setdefault(effect, {})
        if coefficient in given:
            raise ValueError(f"effect must name each coefficient once; got {effect}.{coefficient} twice. Remove one.")
        given[coefficient] = value
    return tuple(UNDECLARED[name](**values[name]) for name in sorted(values, key=list(UNDECLARED).index))


def _parse(text: str) -> tuple[str, str, float]:
    key, equals, number = text.partition("=")
    name, dot, coefficient = key.strip().partition(".")
    if name not in UNDECLARED:
        raise ValueError(f"effect must be one that exists; got '{name}'. {_nearest(name, UNDECLARED)}")
    known = [c.name for c in UNDECLARED[name].coefficients]
    example = f"{name}.{known[0]}=0.1"
    if not (dot and equals):
        raise ValueError(f"effect must read NAME.COEFFICIENT=VALUE; got '{text}'. Write for instance {example}.")
    if coefficient not in known:
        raise ValueError(f"effect '{name}' has no coefficient '{coefficient}'. {_nearest(coefficient, known)}")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"effect {name}.{coefficient} must be a number; got '{number}'. Write for instance {example}.")
    return name, coefficient, value


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"Did you mean '{close[0]}'?" if close else f"Known ones: {', '.join(known)}."
