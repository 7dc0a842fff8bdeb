"""Collects the undeclared effects of a simulation: those of model files, and three that none can name.

Those three test whether a diagnosis reports an unexplained part if the catalogue lacks the explanation.
"""

import math
from collections import ChainMap
from collections.abc import Iterable, Mapping
from typing import Final, cast

import torch
from torch import Tensor

from ballfg.checks import did_you_mean
from ballfg.dynamics.effect import Coefficient, Effect, Flight, FlightEffect, vector
from ballfg.dynamics.effects.registry import EFFECTS

SOFT_START: Final = 0.1  # m. Distance over which the growth of thick air sets in, so that the force has no kink
SOFT_SPEED: Final = 0.1  # m/s. Below it the direction of flight fades, so that a ball at rest has none


class Pull(FlightEffect):
    """a = strength d / sqrt(|d|^2 + soft^2), with d from the ball to the place: of constant size away from it."""

    name = "pull"
    sentence = "A force toward one place in the room."
    decide = "Nothing to decide: no catalogue holds it."
    coefficients = (
        Coefficient("strength", 0.0, 0.3, "m/s^2", -20.0, 20.0),
        Coefficient("x", 1.4, 1.0, "m", -100.0, 100.0, absent=None),
        Coefficient("y", 0.5, 0.5, "m", -100.0, 100.0, absent=None),
        Coefficient("z", 1.5, 0.5, "m", -100.0, 100.0, absent=None),
        Coefficient("soft", 0.3, 0.1, "m", 0.01, 100.0, absent=None),
    )

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2 toward the place; zero in it."""
        way = vector(self.x, self.y, self.z) - flight.position
        return self.strength * way / (way.square().sum(-1, keepdim=True) + self.soft.square()).sqrt()


class ThickAir(FlightEffect):
    """k (1 + growth d) in place of the declared drag's k, with d = (x + sqrt(x^2 + soft^2)) / 2 beyond a start in x.

    A state has no clock: the way along the launcher's x axis stands for the time since the launch.
    """

    name = "thick_air"
    sentence = "The drag grows during the flight."
    decide = "Nothing to decide: no catalogue holds it."
    coefficients = (
        Coefficient("growth", 0.0, 0.2, "1/m", -10.0, 10.0),
        Coefficient("start_x", 0.0, 0.5, "m", -100.0, 100.0, absent=None),
    )
    needs = ("drag",)

    def adjust(self, flight: Flight) -> Flight:
        """The flight with a drag that grows with the distance."""
        beyond = flight.position[..., :1] - self.start_x
        return flight.more_drag(self.growth * 0.5 * (beyond + (beyond.square() + SOFT_START**2).sqrt()))


class SideLean(FlightEffect):
    """a = strength v_z (z x v) / sqrt(|v|^2 + soft^2): across the flight, one way up and the other way down."""

    name = "side_lean"
    sentence = "A force across the flight that changes its side at the apex."
    decide = "Nothing to decide: no catalogue holds it."
    coefficients = (Coefficient("strength", 0.0, 0.3, "1/s", -20.0, 20.0),)

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, horizontal."""
        x, y, z = flight.velocity.split(1, dim=-1)
        across = torch.cat((-y, x, torch.zeros_like(z)), dim=-1)
        return self.strength * z * across / (flight.velocity.square().sum(-1, keepdim=True) + SOFT_SPEED**2).sqrt()


NOWHERE: Final[dict[str, type[Effect]]] = {effect.name: effect for effect in (Pull, ThickAir, SideLean)}
"""Effects that no model file can declare."""


UNDECLARED: Final[Mapping[str, type[Effect]]] = ChainMap(NOWHERE, cast(dict[str, type[Effect]], EFFECTS))
"""Every effect by name: the registered ones, including later registrations, and then those of `NOWHERE`. Any declarable
effect can be undeclared: an effect that the model lacks (wind), or another value of one that it has (restitution.e)."""


def parse_effects(texts: Iterable[str]) -> tuple[Effect, ...]:
    """Effects from texts such as `wind.x=0.3`; unnamed coefficients keep their defaults.

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
        hint = did_you_mean(name, UNDECLARED) or f" Known ones: {', '.join(UNDECLARED)}."
        raise ValueError(f"effect must be one that exists; got '{name}'.{hint}")
    known = [c.name for c in UNDECLARED[name].coefficients]
    example = f"{name}.{known[0]}=0.1"
    if not (dot and equals):
        raise ValueError(f"effect must read NAME.COEFFICIENT=VALUE; got '{text}'. Write for instance {example}.")
    if coefficient not in known:
        hint = did_you_mean(coefficient, known) or f" Known ones: {', '.join(known)}."
        raise ValueError(f"effect '{name}' has no coefficient '{coefficient}'.{hint}")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"effect {name}.{coefficient} must be a number; got '{number}'. Write for instance {example}.")
    return name, coefficient, value
