"""Checks the declarations of an effect class for missing and contradicting entries."""

from typing import NamedTuple

from torch import nn

from ballfg.dynamics.effect import BounceEffect, Coefficient, Effect, FlightEffect, Range, Usual
from ballfg.dynamics.measurement import MeasurementEffect
from ballfg.dynamics.wording import said

REMEDY = "docs/add_an_effect.md has an example."
BASES = (FlightEffect, BounceEffect, MeasurementEffect)


def check_effect(effect: type[Effect]) -> None:
    """Refuses a class whose words or coefficients are missing, wrong, or contradict each other.

    Raises: ValueError: the message names the class, the attribute and the rule.
    """
    where = effect.__qualname__
    for word in ("sentence", "decide"):
        if not (isinstance(getattr(effect, word, None), str) and getattr(effect, word).strip()):
            raise ValueError(f"{where}.{word} must be a text; it is missing. {REMEDY}")
    if not effect.name.isidentifier():
        raise ValueError(f"{where}.name must be letters, digits and _; got '{effect.name}'. Rename it.")
    kind = next(base.kind for base in BASES if issubclass(effect, base))
    if effect.kind != kind:
        raise ValueError(f"{where}.kind must be that of its base, '{kind}'; got '{effect.kind}'. Leave it out.")
    _check_coefficients(effect)
    _check_knowledge(effect)


def _check_knowledge(effect: type[Effect]) -> None:
    """Checks the optional declarations of a class."""
    owners = ("rig",) if effect.kind == "measurement" else ("ball", "room")
    if effect.belongs_to not in owners:
        raise ValueError(
            f"{effect.name}.belongs_to must be {' or '.join(owners)}; got {effect.belongs_to!r}. Correct it."
        )
    if not (effect.plausible is None or isinstance(effect.plausible, Range)):
        raise ValueError(f"{effect.name}.plausible must be a Range; got {effect.plausible!r}. {REMEDY}")
    strengths = [c.name for c in effect.coefficients if c.absent is not None]
    if not (effect.usual is None or (isinstance(effect.usual, Usual) and set(effect.usual.change) <= set(strengths))):
        raise ValueError(
            f"{effect.name}.usual must be a Usual of {', '.join(strengths)}; got {effect.usual!r}. {REMEDY}"
        )
    try:
        said(effect.says, {c.name: _Example(c.default, c.sigma) for c in effect.coefficients})
    except (KeyError, ValueError, IndexError, AttributeError, TypeError) as error:
        raise ValueError(
            f"{effect.name}.says must have fields such as {{{strengths[0]}:.2g}}; got '{effect.says}' ({error!r}). "
            f"{REMEDY}"
        ) from error


class _Example(NamedTuple):
    value: float
    sigma: float


def _check_coefficients(effect: type[Effect]) -> None:
    listed = getattr(effect, "coefficients", None)
    if not (isinstance(listed, tuple) and listed and all(isinstance(c, Coefficient) for c in listed)):
        raise ValueError(f"{effect.name}.coefficients must be a tuple of Coefficient; got {listed!r}. {REMEDY}")
    names = [c.name for c in listed]
    for c in listed:
        where = f"{effect.name}.{c.name}"
        taken = names.count(c.name) > 1 or hasattr(effect, c.name) or hasattr(nn.Module(), c.name)
        if taken or not c.name.isidentifier():
            raise ValueError(f"{where} must be a name of its own; it is taken or no name. Rename the coefficient.")
        if not (c.low <= c.default <= c.high and c.sigma >= 0.0):
            raise ValueError(f"{where} must have low <= default <= high and sigma >= 0; got {c}. Mend it.")
        if c.absent is not None and c.sigma == 0.0:
            raise ValueError(
                f"{where}.sigma must be above 0, a plausible size; got 0. Guess it, or make it a shape (absent=None)."
            )
        if c.absent is not None and not c.low <= c.absent <= c.high:
            raise ValueError(
                f"{where}.absent must lie within [{c.low:g}, {c.high:g}]; got {c.absent:g}. Widen the bounds."
            )
    if all(c.absent is None for c in listed):
        raise ValueError(
            f"{effect.name} must have a coefficient that can be absent; all are shapes (absent=None). Give one a value "
            "at which the effect is not there."
        )
