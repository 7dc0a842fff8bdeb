"""Implements `ballfg info`, `balls` and `effects`, which list what is installed, registered and known."""

import importlib
import math
import os
import platform
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ballfg.cli import inputs
from ballfg.machine import usable_cores
from ballfg.registry import PACKAGE, Registry, source_of

if TYPE_CHECKING:
    from ballfg.dynamics.effect import Effect

REGISTRIES = (
    ("effects", "ballfg.dynamics.effects.registry", "EFFECTS"),
    ("observations", "ballfg.estimation.observations.registry", "OBSERVATIONS"),
    ("estimators", "ballfg.estimation.registry", "ESTIMATORS"),
    ("trainees", "ballfg.learning.trainee", "TRAINEES"),
    ("formats", "ballfg.importing.formats.sources", "FORMATS"),
)
"""Title, module and attribute of each registry, in the order of the output."""
WIDTH = 110  # Largest number of characters in a line


def info() -> None:
    """Show the installed versions, the machine, and what is registered, with the package it comes from.

    Example: ballfg info
    """
    typer.echo(f"{PACKAGE} {version(PACKAGE)}, python {platform.python_version()}")
    needed = required(requires(PACKAGE) or ())
    for title, lines in (("packages", packages(needed)), ("extras", extras(needed)), ("machine", _machine())):
        _show(title, lines)
    for title, module, attribute in REGISTRIES:
        _show(title, _registered(getattr(importlib.import_module(module), attribute)))


def _show(title: str, lines: Iterator[str]) -> None:
    typer.echo(f"\n{title}")
    for line in lines:
        typer.echo(textwrap.fill(line, WIDTH, initial_indent="  ", subsequent_indent="      ", break_on_hyphens=False))


def required(requirements: Iterable[str]) -> dict[str | None, list[str]]:
    """Names of a package's required packages (None), and of those of each extra, from its metadata."""
    names: dict[str | None, list[str]] = {None: []}
    for text in requirements:
        extra = re.search(r'extra == "([\w-]+)"', text)
        name = re.split(r"[^\w.-]", text)[0]
        names.setdefault(extra and extra[1], []).append(name)
    return names


def packages(needed: Mapping[str | None, list[str]]) -> Iterator[str]:
    """The required packages, with their versions."""
    for name in needed[None]:
        yield _installed(name) or f"{name} is not installed; pip install {name}"


def extras(needed: Mapping[str | None, list[str]]) -> Iterator[str]:
    """The optional parts of the package: installed, or the command that installs them."""
    for extra, names in needed.items():
        if extra is not None:
            missing = [name for name in names if _installed(name) is None]
            remedy = f"lacks {', '.join(missing)}; pip install '{PACKAGE}[{extra}]'"
            yield f"{extra}: {remedy if missing else ', '.join(str(_installed(name)) for name in names)}"


def _installed(name: str) -> str | None:
    """Name and version of an installed package; None if it is not installed."""
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return None


def _machine() -> Iterator[str]:
    """Operating system, processor cores that this process may use, memory and GPUs."""
    import torch

    yield f"{platform.platform()}, {platform.machine()}"
    memory = ""
    if hasattr(os, "sysconf"):
        memory = f", {os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.1f} GiB memory"
    yield f"{usable_cores()} cores{memory}"
    gpus = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    yield f"GPU: {', '.join(gpus) or 'none'}"


def _registered(classes: Mapping[str, type[Any]]) -> Iterator[str]:
    """The names in a registry, one line for each package of origin."""
    by_source: dict[str, list[str]] = {}
    for name, cls in classes.items():
        source = classes.source(name) if isinstance(classes, Registry) else source_of(cls)
        by_source.setdefault(str(source), []).append(name)
    for source_name, names in by_source.items():
        yield f"{source_name}: {', '.join(names)}"


def balls() -> None:
    """List the balls with a nominal model: size, mass, drag, terminal speed, bounce and court.

    A dataset is of one of them if its radius and mass are within 15 %. Spreads and sources of the coefficients
    stand in docs/physics.md. A badminton shuttle is no ball and has no model.

    Example: ballfg balls
    """
    from ballfg.dynamics import nominal_model
    from ballfg.dynamics.known_balls import KNOWN_BALLS
    from ballfg.dynamics.model_file import model_to_dict

    titles = ("name", "radius mm", "mass g", "drag k 1/m", "terminal m/s", "restitution", "court m")
    typer.echo(f"{titles[0]:<13}" + "".join(f"{title:>14}" for title in titles[1:]) + "  radius and mass by")
    for name, known in KNOWN_BALLS.items():
        model = model_to_dict(nominal_model(name))
        drag, gravity = model["flight"]["drag"]["k"], model["flight"]["gravity"]["g"]
        numbers = (
            f"{1e3 * known.ball.radius:.2f}",
            f"{1e3 * known.ball.mass:.1f}",
            f"{drag:.4g}",
            f"{math.sqrt(gravity / drag):.1f}",  # the drag k v^2 equals g
            f"{model['bounce']['restitution']['e']:.3g}",
            "-" if known.court is None else "{:g} x {:g}".format(*known.court),
        )
        typer.echo(f"{name:<13}" + "".join(f"{number:>14}" for number in numbers) + f"  {known.source}")


def effects(
    names: Annotated[list[str] | None, typer.Argument(help="Effects to describe; by default all are listed.")] = None,
    effects_file: inputs.EffectsFiles = None,
) -> None:
    """List the effects, or tell all that is known of some: coefficients, usual strength, plausible range, sources.

    Example: ballfg effects wind magnus
    """
    from ballfg.dynamics import EFFECTS

    inputs.know(effects_file)
    for chosen in [EFFECTS.lookup(name) for name in names or ()]:
        typer.echo("\n".join(_described(chosen)) + "\n")
    if not names:
        for name, effect in EFFECTS.items():
            typer.echo(f"{name:<24}{effect.kind:<13}{effect.belongs_to:<6}{effect.plain or name.replace('_', ' ')}")


def _described(effect: "type[Effect]") -> Iterator[str]:
    yield f"{effect.name}: {effect.plain or effect.name.replace('_', ' ')}, an effect of {effect.kind}"
    told = {
        "what": effect.sentence,
        "law": (effect.__doc__ or "").partition("\n")[0],
        "of": f"the {effect.belongs_to}",
        "needs": ", ".join(effect.needs),
        "decide": effect.decide,
    }
    for c in effect.coefficients:
        absent = "a shape" if c.absent is None else f"absent at {c.absent:g}"
        told[c.name] = (
            f"default {c.default:g}, {absent}, prior sigma {c.sigma:g}, {c.low:g} to {c.high:g}, unit {c.unit}"
        )
    if effect.usual is not None:
        change = ", ".join(f"{name} {step:+g}" for name, step in effect.usual.change.items())
        told["usual"] = f"{change} ({effect.usual.source})"
    if effect.plausible is not None:
        told["plausible"] = f"{effect.plausible.low:g} to {effect.plausible.high:g} ({effect.plausible.source})"
    for word, line in told.items():
        if line:
            yield textwrap.fill(f"{word}: {line}", WIDTH, initial_indent="  ", subsequent_indent="      ")
