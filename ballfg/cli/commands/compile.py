"""Implements `ballfg compile`, which makes machine code ahead of its first use, and `export`, which makes C of it."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ballfg.cli import inputs
from ballfg.progress import print_notes, progress

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
    from ballfg.dynamics.compiled.kept_model import about_file, keep
    from ballfg.dynamics.known_balls import KNOWN_BALLS
    from ballfg.dynamics.nominal import keep_nominal

    inputs.know(effects_file)
    models: dict[str, BallModel] = {name: nominal_model(name) for name in KNOWN_BALLS}
    inertia = KNOWN_BALLS["table_tennis"].inertia_factor
    files = {path: load_model(path, inertia_factor=inertia) for path in model or ()}
    models |= {str(path): one for path, one in files.items()}
    for known in KNOWN_BALLS.values():
        keep_nominal(known.ball)
    for path, one in files.items():
        for radius in (None, one.radius):  # as arrays ask for it, and as a dataset of that ball does
            keep(about_file(path, radius, inertia), one)
    parts = [part for one in models.values() for part in _parts(one)]
    parts.append(partial(_search, models["table_tennis"]))  # its code is the same for all balls
    for part in progress(parts, len(parts), "parts compiled"):
        part()
    print(f"{', '.join(models)}: compiled, and kept in {cache_folder()}")


def _parts(model: "BallModel") -> list[Callable[[], object]]:
    """The functions of an estimate, a stream and their predictions, with the settings of commands."""
    from ballfg.dynamics import Surfaces
    from ballfg.estimation import Online, Settings, Smoother, estimate_noise
    from ballfg.estimation.measurement.as_measured import plainly_measured
    from ballfg.estimation.online.warm_up import falling_ball
    from ballfg.estimation.settings import SOLVERS
    from ballfg.tracks import Track

    model, table = plainly_measured(model), Surfaces.table_tennis(0.0)  # measurement effects are undone around it
    settings = Settings.for_measured(model, position_noise=(0.003,) * 3)
    smoother = Smoother(model, table, settings)
    streams = [Online(model, table, replace(settings, solver=solver)) for solver in SOLVERS]
    track = Track(*falling_ball(streams[0]), name="falling")
    noise = partial(estimate_noise, model, table, settings, [track], errors=False)
    return [partial(smoother.estimate, track), noise, *(online.warm_up for online in streams)]


def _search(model: "BallModel") -> None:
    """Looks for strokes in pictures with one candidate each, so that all functions of the search are there."""
    import numpy as np

    from ballfg.dynamics import Surfaces
    from ballfg.estimation.rally.arcs import arcs
    from ballfg.estimation.rally.field import Field
    from ballfg.estimation.rally.strokes import Grower
    from ballfg.estimation.segmentation.physics import physics_of
    from ballfg.vision.camera import Camera
    from ballfg.vision.detection.detections import Candidates, Detections

    one = np.zeros((1, 2)), np.eye(2)[None], np.ones(1), np.full((1, 2, 2), np.nan)
    found = Detections.of_frames("main", [(0.04 * k, Candidates(one[0] + 20.0 * k, *one[1:])) for k in range(5)])
    matrix = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]])
    camera = Camera("main", (1280, 720), matrix, np.zeros(4), np.array([2.0, 0.0, 0.0]), np.array([0.0, 0.0, 9.0]))
    seeds, field, _ = arcs(Field.of(found, 100.0))
    grower = Grower.of(field, found.times, camera, physics_of(model), Surfaces.table_tennis(0.0))
    for flight in grower.flights(seeds)[:1]:
        grower.whole(flight)
        list(grower.bounced(flight, 1))


def export(
    model: Annotated[str, typer.Argument(help="Model file, or a known ball by its name in ballfg balls.")],
    out: Annotated[Path, typer.Option(help="Header to write; its name begins the names of its functions.")],
    language: Annotated[Literal["c"], typer.Option(help="Language: C99, which C++ reads too.")] = "c",
    ball: Annotated[
        str | None,
        typer.Option(help="Known ball that gives a model file radius and inertia.", show_default="table_tennis"),
    ] = None,
    group: Annotated[
        str | None,
        typer.Option(help="Group of the model whose coefficients the header has.", show_default="what all share"),
    ] = None,
    effects_file: inputs.EffectsFiles = None,
) -> None:
    """A model as one C header: flight, contacts, Jacobians, predictions with covariance. It needs no library.

    It computes what ballfg computes, from the same translation of the model, networks too. Compile with -O3.

    Example: ballfg export model.yaml --language c --out ball.h
    """
    from ballfg.estimation import Settings
    from ballfg.files.whole_file import check_file, write_text
    from ballfg.prediction.c_header import c_header

    check_file(out)
    if out.suffix != ".h":
        raise ValueError(f"out must be a header; got {out}. Let its name end in .h.")
    inputs.know(effects_file)
    path = None if re.fullmatch(r"[\w -]+", model) and not Path(model).is_file() else Path(model)
    if path is None and ball is not None:
        raise ValueError(f"ball must come with a model file; got {ball!r} with '{model}'. Leave one of them out.")
    known, settings = inputs.model_alone(path, model if path is None else ball)
    Settings(spins=known.spins, group=group)  # refuses what is no group of the model
    if group is not None and known.spins is not None:
        known = known.for_group(known.spins.by, group)
    print_notes(_shared(known, group))
    if not known.measures_plainly:
        print_notes(["measurement effects are left out: the header has true positions, not those as measured"])
    write_text(out, c_header(known, out.stem, settings.process))
    print(f"{out}: {out.stem}_fly, {out.stem}_contact, {out.stem}_predict, {out.stem}_cross_plane")


def _shared(model: "BallModel", group: str | None) -> Iterator[str]:
    """A note on each coefficient that differs between tracks, of which the header has one value.

    Args: group: whose coefficients the model has already; None: none.
    """
    values = dict(model.named_parameters())
    for name, variation in model.variations.items():
        known = model.spins is not None and variation.by == model.spins.by
        if not known or group is None or variation.of_label(group) is None:
            remedy = " Give --group NAME for a group's." if known and group is None else ""
            own = float(values[name].detach())
            yield f"{name} differs by {variation.by}; the header has {own:g}, that of other tracks.{remedy}"
