"""Implements `ballfg import`, which turns a user's own files into a dataset."""

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer

from ballfg.progress import counted, idle, print_doubts

if TYPE_CHECKING:
    from ballfg.importing import Choices
    from ballfg.importing.choices import UndecidedError
    from ballfg.importing.proposal import Proposal

_guess, _file = (partial(typer.Option, rich_help_panel=panel) for panel in ("Instead of a guess", "Files"))
WIDTH = 160  # Number of characters in a line of the proposal without a terminal


def import_(
    sources: Annotated[list[Path], typer.Argument(metavar="SOURCE...", help="Files and folders to import.")],
    out: Annotated[Path, _file("--out", help="Folder of the new dataset.")],
    columns: Annotated[str, _guess(help="Roles of columns, as t=stamp,x=X,y=Y,z=Z,trajectory=shot.")] = "",
    length: Annotated[str | None, _guess(help="Unit of positions: m, cm, mm, in or ft.")] = None,
    time: Annotated[str | None, _guess(help="Unit of times: s, ms, us or ns.")] = None,
    up: Annotated[str | None, _guess(help="Axis that points up: x, y, z, -x, -y or -z.")] = None,
    flip: Annotated[str | None, _guess(help="Axis to mirror, for a left-handed frame: x, y or z.")] = None,
    table_height: Annotated[
        float | None, _guess(help="z of the table's surface in the new frame, m; no surface if no ball bounces.")
    ] = None,
    split_gap: Annotated[float | None, _guess(help="Gap after which a new shot begins, s.")] = None,
    ball: Annotated[str | None, _guess(help="One of `ballfg balls`, or a ball file (YAML).")] = None,
    rate: Annotated[float | None, _guess(help="Frames per second, where there are frames and no times.")] = None,
    key: Annotated[
        str | None, _guess("--key", "--sheet", help="Table, sheet or group, where a source holds several.")
    ] = None,
    topic: Annotated[str | None, _guess(help="Topic of a ROS bag.")] = None,
    flights: Annotated[
        bool, _guess("--flights", help="Cut the flights out: one track each, without what is held, rolls or rests.")
    ] = False,
    name: Annotated[str | None, _file(help="Name of the dataset; that of the folder by default.")] = None,
    format: Annotated[str, _file(help="Format of the tracks: csv or parquet.")] = "csv",
    force: Annotated[bool, _file("--force", help="Replace a dataset.")] = False,
) -> None:
    """Import tracks from your own files: any columns, units and axes.

    It shows what it understood and why, and writes the dataset with a page to check it, import.html.

    A guess that is not safe is asked for on a terminal, and refused elsewhere with the option that decides it.

    Example: ballfg import shots.csv --out my_shots
    """
    from ballfg.files.whole_folder import check_replaceable
    from ballfg.importing import Choices
    from ballfg.importing.choices import parse_columns
    from ballfg.importing.importer import write_import

    if format not in ("csv", "parquet"):
        raise ValueError(f"--format must be csv or parquet; got {format!r}. Choose one of them.")
    check_replaceable(out, mark="dataset.yaml", what="a dataset", force=force)
    choices = Choices(
        parse_columns(columns) if columns else {}, length, time, up, flip, table_height, split_gap, ball, rate, key,
        topic, name or out.resolve().name, flights,
    )  # fmt: skip
    proposal = _proposed(sources, choices)
    print_doubts(proposal.info.doubts)
    _show(proposal)
    write_import(out, proposal, cast(Literal["csv", "parquet"], format), force)
    samples = sum(len(track) for track in proposal.tracks)
    wrote = f"{counted(len(proposal.tracks), 'shot')}, {counted(samples, 'sample')}"
    typer.echo(f"wrote {wrote} to {out}; look at {out / 'import.html'}")


def _proposed(sources: list[Path], choices: "Choices") -> "Proposal":
    """The proposal; on a terminal the user answers the unsafe guesses."""
    from ballfg.importing.choices import AllUndecidedError, UndecidedError
    from ballfg.importing.proposal import MOST_QUESTIONS, propose

    for _ in range(MOST_QUESTIONS):
        try:
            return propose(sources, choices)
        except UndecidedError as question:
            if not (sys.stdin.isatty() and sys.stderr.isatty()):
                raise
            one = question.questions[0] if isinstance(question, AllUndecidedError) else question
            choices = _answered(one, choices)
    return propose(sources, choices)


def _answered(question: "UndecidedError", choices: "Choices") -> "Choices":
    from ballfg.importing.choices import decided

    default = question.choices[0] if question.choices else None
    with idle():  # the user may take time to answer
        answer = typer.prompt(f"{question}\n--{question.option}", default=default, err=True)
    return decided(choices, question.option, answer)


def _show(proposal: "Proposal") -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for head in ("what", "guess", "why", "how sure", "change it with"):
        table.add_column(head, overflow="fold", no_wrap=head in ("what", "how sure"))
    for guess in proposal.guesses:
        table.add_row(*(Text(part) for part in (guess.what, guess.value, guess.why, guess.sure, guess.option)))
    Console(width=None if sys.stdout.isatty() else WIDTH).print(table)
    for note in proposal.notes:
        typer.echo(f"note: {note}")
