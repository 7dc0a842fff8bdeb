"""The effects a model file may name: one line for each. docs/add_an_effect.md shows how to add one, here or outside."""

from pathlib import Path
from typing import Final

from ballfg.checks import check_path
from ballfg.dynamics.effect import Effect, Kind
from ballfg.dynamics.effects import bounce, flight, generic, measurement
from ballfg.dynamics.effects.checks import BASES, REMEDY, check_effect
from ballfg.files.python_file import run_file
from ballfg.registry import Registry

GENERIC: Final[dict[str, type[Effect]]] = {
    effect.name: effect for effect in (generic.GenericFlight, generic.GenericContact, generic.GenericMeasurement)
}
"""Sums of terms that a model file may name too. They describe without explaining, so no search for causes has them."""


def _check(effect: type[Effect]) -> None:
    check_effect(effect)
    unknown = sorted(name for name in effect.needs if name not in EFFECTS)
    if unknown:
        raise ValueError(
            f"{effect.name}.needs must name known effects; got '{unknown[0]}'. Register that one first, or define it "
            "above."
        )


EFFECTS: Final = Registry[Effect](
    "effect", group="ballfg.effects", base=BASES, remedy=REMEDY, check=_check, reserved=GENERIC
)
"""Every effect that a search for causes may find, by the name that model files use."""

for _effect in (
    flight.Gravity,
    flight.Drag,
    flight.Magnus,
    flight.SpinDecay,
    flight.Wind,
    flight.WindShear,
    flight.GustRegion,
    flight.DragSpeed,
    flight.DragSpin,
    flight.MagnusSaturation,
    flight.Buoyancy,
    bounce.Restitution,
    bounce.Friction,
    bounce.TangentialRestitution,
    bounce.TableHeight,
    bounce.RestitutionSpeed,
    bounce.TableTilt,
    measurement.TimeOffset,
    measurement.VelocityLag,
    measurement.FrameTilt,
    measurement.Scale,
    measurement.RadialBias,
    measurement.Distortion,
    measurement.TimeScale,
    measurement.CountedFrames,
    measurement.SpinLabelFrame,
    measurement.SpinLabelScale,
    measurement.SpinLabelOffset,
):
    EFFECTS.register(_effect)

register = EFFECTS.register


def effect_class(name: str, kind: Kind) -> type[Effect]:
    """The class of the effect `name` of a kind: `flight`, `bounce` or `measurement`.

    Raises: ValueError: if there is no such effect of that kind; the message lists those there are.
    """
    effect = EFFECTS.get(name) or GENERIC.get(name)
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
    path = check_path("path", path).resolve()
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
