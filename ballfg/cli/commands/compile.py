"""Implements `ballfg compile`, which makes machine code ahead of its first use, and `export`, which makes C of it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ballfg.cli import inputs
from ballfg.progress import progress

if TYPE_CHECKING:
    from ballfg.dynamics import BallModel


def compile_ahead(
    model: Annotated[
        list[Path] | None,
        typer.Option("--model", help="Model file to compile as well; may be repeated."),
    ] = None,
    effects_file: inputs.EffectsFiles = None,
) -> None:
    """Compile the machine code of estimates, predictions, noise and streams, for the balls that ship and model files.

    What is compiled is kept on disk. The first estimate on a machine then takes 3 s; without, it compiles for half a
    minute. A change of coefficients or weights needs no new code, another set of effects does.

    Example: ballfg compile --model model.yaml
    """
    from ballfg.dynamics import load_model, nominal_model
    from ballfg.dynamics.compiled.kept import cache_folder
    from ballfg.dynamics.known_balls import KNOWN_BALLS

    inputs.know_effects(effects_file)
    models: dict[str, BallModel] = {name: nominal_model(name) for name in KNOWN_BALLS}
    models |= {str(path): load_model(path) for path in model or ()}
    parts = [part for one in models.values() for part in _parts(one)]
    for part in progress(parts, len(parts), "parts compiled"):
        part()
    print(f"{', '.join(models)}: compiled, and kept in {cache_folder()}")


def _parts(model: BallModel) -> list[Callable[[], object]]:
    """The functions of an estimate, a stream and their predictions, with the settings of commands."""
    from ballfg.dynamics import Surfaces
    from ballfg.estimation import Online, Settings, Smoother, estimate_noise
    from ballfg.estimation.online.warm_up import falling_ball
    from ballfg.estimation.settings import SOLVERS
    from ballfg.tracks import Track

    table = Surfaces.table_tennis(0.0)
    settings = Settings.for_measured(model, position_noise=(0.003,) * 3)
    smoother = Smoother(model, table, settings)
    streams = [Online(model, table, replace(settings, solver=solver)) for solver in SOLVERS]
    track = Track(*falling_ball(streams[0]), name="falling")
    noise = partial(estimate_noise, model, table, settings, [track], errors=False)
    return [partial(smoother.estimate, track), noise, *(online.warm_up for online in streams)]


def export(
    model: Annotated[str, typer.Argument(help="Model file, or a known ball by its name in ballfg balls.")],
    out: Annotated[Path, typer.Option(help="Header to write; its name begins the names of its functions.")],
    language: Annotated[Literal["c"], typer.Option(help="Language: C99, which C++ reads too.")] = "c",
    ball: Annotated[
        str | None,
        typer.Option(help="Known ball that gives a model file radius and inertia.", show_default="table_tennis"),
    ] = None,
    effects_file: inputs.EffectsFiles = None,
) -> None:
    """A model as one C header: flight, contacts, Jacobians, predictions with covariance. It needs no library.

    It computes what ballfg computes, from the same translation of the model, networks too. Compile with -O3.

    Example: ballfg export model.yaml --language c --out ball.h
    """
    from ballfg.files.whole_file import check_file, write_text
    from ballfg.prediction.c_header import c_header

    check_file(out)
    if out.suffix != ".h":
        raise ValueError(f"out must be a header; got {out}. Let its name end in .h.")
    inputs.know_effects(effects_file)
    path = None if re.fullmatch(r"[\w -]+", model) and not Path(model).is_file() else Path(model)
    if path is None and ball is not None:
        raise ValueError(f"ball must come with a model file; got {ball!r} with '{model}'. Leave one of them out.")
    known, settings = inputs.model_alone(path, model if path is None else ball)
    write_text(out, c_header(known, out.stem, settings.process))
    print(f"{out}: {out.stem}_fly, {out.stem}_contact, {out.stem}_predict, {out.stem}_cross_plane")
