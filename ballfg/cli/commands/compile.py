"""Implements `ballfg compile`, which compiles machine code ahead of its first use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
