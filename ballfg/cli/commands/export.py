"""Implements `ballfg export`, which writes a model in the language of a robot's controller."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from ballfg.cli import inputs


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
