"""Registers the effects that a model file may name: those of this folder and those of other packages."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Final

from ballfg.dynamics import effects
from ballfg.dynamics.effect import Effect, Kind
from ballfg.dynamics.effects import generic
from ballfg.dynamics.effects.checks import BASES, REMEDY, check_effect
from ballfg.files.python_file import defined_classes, load_classes
from ballfg.registry import Registry

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


def _check(effect: type[Effect]) -> None:
    check_effect(effect)
    unknown = sorted(name for name in effect.needs if name not in EFFECTS)
    if unknown:
        raise ValueError(
            f"{effect.name}.needs must name known effects; got '{unknown[0]}'. Register that one first, or define it "
            "above."
        )


EFFECTS: Final = Registry[Effect](
    "effect", group="ballfg.effects", base=BASES, remedy=REMEDY, check=_check, reserved={**GENERIC, **LEARNED}
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
