"""Effects of one's own: classes that model files, simulations and diagnoses then know by name."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from torch import nn

from ballfg.dynamics.effect import BounceEffect, Coefficient, Effect, FlightEffect
from ballfg.dynamics.effects.registry import EFFECTS, GENERIC
from ballfg.dynamics.measurement import MeasurementEffect
from ballfg.files.python_file import run_file

E = TypeVar("E", bound=type[Effect])

REMEDY = "docs/add_an_effect.md has an example."
BASES = (FlightEffect, BounceEffect, MeasurementEffect)


def register(effect: E) -> E:
    """Let an effect be named wherever those of the package are; may decorate the class.

    A class that is defined anew, as when a cell of a notebook runs again, takes the place of the one before.

    Args: effect: a subclass of `FlightEffect`, `BounceEffect` or `MeasurementEffect`.
    Returns: the same class.
    Raises:
        TypeError: if it is no such class.
        ValueError: if its name is taken or something that it must say is missing or contradicts itself.
    """
    if not (isinstance(effect, type) and issubclass(effect, BASES)):
        raise TypeError(
            f"effect must be a subclass of FlightEffect, BounceEffect or MeasurementEffect; got {effect!r}. {REMEDY}"
        )
    _check_words(effect)
    _check_coefficients(effect)
    taken = (EFFECTS | GENERIC).get(effect.name)
    if taken is not None and _origin(taken) != _origin(effect):
        raise ValueError(
            f"name of an effect must be its own; got '{effect.name}', that of {'.'.join(_origin(taken))}. Rename one."
        )
    unknown = sorted(set(effect.needs) - set(EFFECTS))
    if unknown:
        raise ValueError(
            f"{effect.name}.needs must name known effects; got '{unknown[0]}'. Register that one first, or define it "
            "above."
        )
    EFFECTS[effect.name] = effect
    return effect


def load_effects(path: str | Path) -> tuple[type[Effect], ...]:
    """Run a Python file and register the effects that it defines; those whose class begins with `_` are left out.

    Args: path: of a file that you trust: all of its code runs.
    Returns: the classes, in the order in which they stand there.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no Python, does not run, defines no effect, or one that `register` refuses.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"effects file {path} does not exist; effects of one's own are one Python file.")
    module = run_file(path, "effects")
    own = [
        item
        for name, item in vars(module).items()
        if isinstance(item, type) and issubclass(item, Effect) and item.__module__ == module.__name__ and name[0] != "_"
    ]
    if not own:
        raise ValueError(f"{path} must define an effect, a class; it defines none. {REMEDY}")
    try:
        return tuple(register(effect) for effect in own)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def _origin(effect: type[Effect]) -> tuple[str, str]:
    return effect.__module__, effect.__qualname__


def _check_words(effect: type[Effect]) -> None:
    said = effect.__qualname__
    for word in ("name", "sentence", "decide"):
        if not (isinstance(getattr(effect, word, None), str) and getattr(effect, word).strip()):
            raise ValueError(f"{said}.{word} must be a text; it is missing. {REMEDY}")
    if not effect.name.isidentifier():
        raise ValueError(f"{said}.name must be letters, digits and _; got '{effect.name}'. Rename it.")
    kind = next(base.kind for base in BASES if issubclass(effect, base))
    if effect.kind != kind:
        raise ValueError(f"{said}.kind must be that of its base, '{kind}'; got '{effect.kind}'. Leave it out.")


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
