"""Starts each program: parses its arguments, adds the option --quiet, shows progress, returns an exit status."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Annotated, Any, NoReturn

import typer

from ballfg.cli.errors import check_words, guarded
from ballfg.progress import alive, be_quiet

UNREAD = 141
"""Exit status after the reader of stdout has left, as `head` does; shells show it for a program ended by SIGPIPE."""


def start(app: typer.Typer, name: str, arguments: Sequence[str] | None) -> NoReturn:
    """Runs a program with the given arguments, by default the command line's, and exits.

    Args: app: the program.  name: its name for users.  arguments: of the command line.
    Raises: SystemExit: always; status 0, 2 on bad input, 130 after Ctrl-C, 141 if nobody reads the output, or the
        command's own.
    """
    command = _command(app)
    given = sys.argv[1:] if arguments is None else list(arguments)

    def work() -> object:
        check_words(given)
        with alive(" ".join([name, *given[:1]])):
            return command.main(given, prog_name=name, standalone_mode=False)

    sys.exit(_while_read(partial(guarded, work)))


def _while_read(run: Callable[[], int]) -> int:
    """The exit status of a program, or silently `UNREAD` if nobody reads its output any more."""
    try:
        status = run()
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        pass
    except SystemExit as leaving:  # raised by click, with status 1
        if not isinstance(leaving.__context__, BrokenPipeError):
            raise
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # else the interpreter complains when it flushes the rest
    return UNREAD


@cache
def _command(app: typer.Typer) -> Any:
    """A program's command line, each command with --quiet; built once in a process."""
    command, quiet = typer.main.get_command(app), _quiet()
    for one in _commands(command):
        one.params.append(quiet)
    return command


def _commands(command: Any) -> Iterator[Any]:
    """A group's commands, or the command itself."""
    own = getattr(command, "commands", None)
    yield from own.values() if own else (command,)


def _asked(quiet: bool) -> None:
    if quiet:
        be_quiet()


def _template(
    quiet: Annotated[bool, typer.Option("--quiet", "-q", callback=_asked, help="Show no progress.")] = False,
) -> None:
    """A command whose option all others copy: typer makes options from functions only."""


def _quiet() -> Any:
    template = typer.Typer(add_completion=False)
    template.command()(_template)
    option = next(p for p in typer.main.get_command(template).params if p.name == "quiet")
    option.expose_value = False
    return option
