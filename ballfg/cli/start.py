"""Starts each program, and turns errors that a user can mend into one line on stderr and an exit status."""

import errno
import os
import sys
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Annotated, Any, Final, NoReturn

import typer

from ballfg.interrupts import interrupted, say_so
from ballfg.progress import alive, be_quiet

BAD_INPUT = 2  # Exit status for input that cannot be used
NOT_ESTIMATED = 3  # Exit status if everything was written, but some tracks could not be estimated
INTERRUPTED = 130  # Exit status after Ctrl-C, as in shells

_LONGEST: Final = 2000  # Largest number of characters of a message; a file of one endless line would fill the terminal
_NAME: Final = 200
"""Largest number of characters of a name that is not text; Linux limits names in a folder to 255 bytes."""
USER_ERRORS = (ValueError, TypeError, OSError, MemoryError)
"""Errors that a user can mend: input, paths, a full disk, too little memory. All others are faults of the program and
keep their traceback."""
NO_MEMORY: Final = "can't allocate memory"  # torch's message in place of a MemoryError


def guarded(command: Callable[[], object]) -> int:
    """Runs a command and turns a user's errors into one line `ballfg: error: ...` and an exit status.

    Args: command: takes no arguments; may raise.
    Returns: 0, 2 for bad input, 3 if some tracks could not be estimated, 128 and the signal's number after Ctrl-C,
        SIGTERM or SIGHUP, or the command's own status.
    """
    try:
        result = command()
    except typer.Exit as request:
        return request.exit_code
    except (KeyboardInterrupt, typer.Abort):
        return say_so()
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # raised by click and rich if nobody reads the output
            raise
        return _left(error)
    except Exception as error:
        return say_so() if interrupted() else _refused(error)  # libraries replace an interrupt by other exceptions
    if result == INTERRUPTED:
        return say_so()
    return result if isinstance(result, int) else 0


def _left(error: SystemExit) -> int:
    """The exit status of a command that ends itself; foreign code that does so is named."""
    where = error.__traceback__
    while where is not None and where.tb_next is not None:
        where = where.tb_next
    if where is None or str(where.tb_frame.f_globals.get("__name__")).partition(".")[0] == __name__.partition(".")[0]:
        raise error
    file = f"{where.tb_frame.f_code.co_filename}, line {where.tb_lineno}"
    return _bad_input(f"code must return or raise; that in {file} has left with status {error.code}. Mend it there.")


def _refused(error: Exception) -> int:
    """The exit status of a user's error, with its line; all others are raised again."""
    if isinstance(error, USER_ERRORS):
        if type(error).__name__ == "LinAlgError":  # numpy derives it from ValueError, but no user can mend it
            raise error
        return _bad_input(_in_words(error))
    # errors in the use of a command: typer's base class differs between versions, their method does not
    message, cause = getattr(error, "format_message", None), error.__context__
    if isinstance(cause, OSError) and cause.errno == errno.ELOOP:  # from `Path.resolve` before Python 3.13
        return _bad_input(_in_words(cause))
    if message is None and NO_MEMORY in str(error):
        return _bad_input(_in_words(MemoryError(f"torch {NO_MEMORY}")))
    if message is None:
        raise error
    return _bad_input(message().replace(": Value error, ", ": "), getattr(error, "ctx", None))


def _in_words(error: Exception) -> str:
    if isinstance(error, MemoryError):
        why = f" ({error})" if str(error) else ""
        return f"memory ran out{why}. Use fewer --jobs, fewer or shorter tracks at a time, or more memory."
    if isinstance(error, UnicodeEncodeError):
        return f"names and texts must be UTF-8; got {error.object[:_NAME]!a}. Rename the file or folder."
    if not isinstance(error, OSError) or error.errno is None:
        return str(error)
    where = "a file could not be read or written" if error.filename is None else str(error.filename)
    return f"{where}: {error.strerror}. Check the path, its permissions and the space on the disk."


def _bad_input(message: str, context: typer.Context | None = None) -> int:
    from ballfg.checks import visible  # not with the module: `ballfg --help` must not wait for numpy

    text = visible(" ".join(message.split()))
    if len(text) > _LONGEST:
        text = f"{text[:_LONGEST]} ... ({len(text) - _LONGEST} characters more)"
    hint = "" if context is None else f" See '{context.command_path} --help'."
    print(f"ballfg: error: {text}{hint}", file=sys.stderr)
    return BAD_INPUT


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
        for word in given:
            word.encode()  # text cannot represent odd file names: refused before any work
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
    own = getattr(command, "commands", None)  # of a group
    for one in own.values() if own else (command,):
        one.params.append(quiet)
    return command


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
