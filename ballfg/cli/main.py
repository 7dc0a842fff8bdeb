"""Defines the app `ballfg` and its entry point. A new sub-command is a file of its own and one line here.

Command files import what they need inside the command: `ballfg --help` must not wait for torch or GTSAM.
"""

from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated

import typer

from ballfg.cli.commands.calibrate_cameras import calibrate_cameras
from ballfg.cli.commands.compile import compile_ahead, export
from ballfg.cli.commands.design import design
from ballfg.cli.commands.diagnose import diagnose
from ballfg.cli.commands.estimate import estimate
from ballfg.cli.commands.example import example
from ballfg.cli.commands.import_ import import_
from ballfg.cli.commands.info import balls, effects, info
from ballfg.cli.commands.live import live
from ballfg.cli.commands.noise import noise
from ballfg.cli.commands.predict import predict
from ballfg.cli.commands.render import render
from ballfg.cli.commands.show import show
from ballfg.cli.commands.simulate import simulate
from ballfg.cli.commands.track import track
from ballfg.cli.start import start

EARLIER_OPTIONS = {"effects": "effects-file"}
"""Earlier names of options, without dashes, that scripts may still use; `--help` shows only today's."""

app = typer.Typer(
    name="ballfg",
    help="From noisy measurements of a flying, bouncing ball to states, predictions and knowledge.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"token_normalize_func": lambda name: EARLIER_OPTIONS.get(name, name)},
)

app.command(name="import")(import_)
app.command()(estimate)
app.command()(predict)
app.command()(live)
app.command()(diagnose)
app.command()(show)
app.command()(design)
app.command()(noise)
app.command()(example)
app.command()(simulate)
app.command()(render)
app.command()(track)
app.command(name="calibrate-cameras")(calibrate_cameras)
app.command(name="compile")(compile_ahead)
app.command()(export)
app.command()(balls)
app.command()(effects)
app.command()(info)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    show_version: Annotated[bool, typer.Option("--version", help="Version of ballfg.")] = False,
) -> None:
    """From noisy measurements of a flying, bouncing ball to states, predictions and knowledge."""
    if show_version:
        typer.echo(f"ballfg {version('ballfg')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def run(arguments: Sequence[str] | None = None) -> None:
    """Runs `ballfg` with the given arguments, by default the command line's, and exits.

    Raises: SystemExit: always; status 0, 2 on bad input, 130 after Ctrl-C.
    """
    start(app, "ballfg", arguments)
