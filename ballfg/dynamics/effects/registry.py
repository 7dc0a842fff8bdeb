"""Checks and registers the effects that a model file may name: those of this folder and those of other packages."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from ballfg.checks import type_name
from ballfg.dynamics import effects
from ballfg.dynamics.effect import BounceEffect, Coefficient, Effect, Flight, FlightEffect, Kind, Range, Usual
from ballfg.dynamics.effects import generic
from ballfg.dynamics.measurement import MeasurementEffect
from ballfg.dynamics.wording import said
from ballfg.files.python_file import defined_classes, load_classes
from ballfg.registry import Registry

REMEDY = "docs/add_an_effect.md has an example."
COLUMNS: Final = {"air_velocity": 3, "acceleration": 3, "spin_rate": 3, "surface_offset": 1, "surface_slope": 2}
"""Columns of what methods return."""
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
    if unknown := sorted(name for name in effect.needs if name not in EFFECTS):
        raise ValueError(
            f"{effect.name}.needs must name known effects; got '{unknown[0]}'. Register that one first, or define it "
            "above."
        )
    _check_methods(effect)


def _check_methods(effect: type[Effect]) -> None:
    """Refuses a class that does nothing, as one with a misspelt method, and methods whose results have wrong shapes.

    Fewer columns would be taken for every axis: torch repeats them without a word.
    """
    base = next(base for base in BASES if issubclass(effect, base))
    methods = [name for name, own in vars(base).items() if inspect.isfunction(own) and not name.startswith("_")]
    if all(getattr(effect, name) is getattr(base, name) for name in methods):
        raise ValueError(
            f"{effect.__qualname__} must have one of the methods {', '.join(methods)}; it has none of them."
        )
    state = torch.arange(1.0, 19.0, dtype=torch.float64).reshape(2, 9)
    example = {"flight": Flight(state, 0.02), "bounce": state[:, :3]}
    for name in [name for name in methods if name in COLUMNS]:
        where, columns = f"{effect.__qualname__}.{name}", COLUMNS[name]
        try:
            with torch.no_grad():
                found = getattr(effect(), name)(example[effect.kind])
        except Exception as error:
            raise ValueError(f"{where} must take a batch of two balls; it raises {error!r}. {REMEDY}") from error
        shapes = ((), (1,), (2, 1)) if columns == 1 else ((columns,), (1, columns), (2, columns))
        if found is None:
            continue
        if not isinstance(found, Tensor) or found.dtype != torch.float64 or tuple(found.shape) not in shapes:
            what = f"{tuple(found.shape)}, {found.dtype}" if isinstance(found, Tensor) else type_name(found)
            raise ValueError(
                f"{where} must return (..., {columns}) in float64, of a batch of two balls (2, {columns}); got {what}. "
                f"{REMEDY}"
            )


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


GENERIC: Final[dict[str, type[Effect]]] = {
    effect.name: effect for effect in (generic.GenericFlight, generic.GenericContact, generic.GenericMeasurement)
}
"""Sums of terms that a model file may name. They describe without explaining, so searches for causes skip them."""


def _own() -> Iterator[type[Effect]]:
    """The effects of the modules of this folder but the generic ones, by kind, module and place in it."""
    names = sorted(f"{__package__}.{module.name}" for module in iter_modules(effects.__path__))
    found = [cls for name in names if name != __name__ for cls in defined_classes(import_module(name), BASES)]
    kinds = [base.kind for base in BASES]
    yield from sorted((cls for cls in found if cls not in GENERIC.values()), key=lambda cls: kinds.index(cls.kind))


OWN: Final = tuple(_own())
LEARNED: Final[dict[str, type[Effect]]] = {effect.name: effect for effect in OWN if effect.learned}
"""Effects that a training writes; searches for causes skip them too."""


EFFECTS: Final = Registry[Effect](
    "effect", group="ballfg.effects", base=BASES, remedy=REMEDY, check=check_effect, reserved={**GENERIC, **LEARNED}
)
"""Every effect that a search for causes may find, by its name in model files."""


for _effect in OWN:
    if not _effect.learned:
        EFFECTS.register(_effect)

register = EFFECTS.register


def effect_class(name: str, kind: Kind) -> type[Effect]:
    """The class of the effect `name` of a kind: `flight`, `bounce` or `measurement`.

    Raises: ValueError: if there is no such effect of that kind; the message lists those there are.
    """
    effect = EFFECTS.get(name) or GENERIC.get(name) or LEARNED.get(name)
    if effect is None or effect.kind != kind:
        known = ", ".join(n for n, e in EFFECTS.items() if e.kind == kind) or "none"
        own = "One of your own must be registered first: --effects-file FILE.py, or ballfg.dynamics.register"
        raise ValueError(f"there is no {kind} effect '{name}'; known ones: {known}. {own}.")
    return effect


def load_effects(path: str | Path) -> tuple[type[Effect], ...]:
    """Run a Python file and register the effects that it defines; those whose class begins with `_` are left out.

    Args: path: of a file that you trust: all of its code runs.
    Returns: the classes, in the order in which they stand there.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no Python, does not run, defines no effect, or one that `register` refuses.
    """
    return load_classes(EFFECTS, path)
