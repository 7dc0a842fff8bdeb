"""What a user sees when something is wrong: one line on stderr and an exit status."""

import errno
import sys
from collections.abc import Callable, Sequence
from typing import Final

import typer

BAD_INPUT = 2
"""Exit status for input that cannot be used."""
NOT_ESTIMATED = 3
"""Exit status where everything was written, but some tracks could not be estimated."""
INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""

_LONGEST: Final = 2000
"""Characters of a message; a file of one endless line would fill the terminal."""
_NAME: Final = 200
"""Characters of a name that is no text; Linux has no longer ones in a folder than 255 bytes."""
USER_ERRORS = (ValueError, TypeError, OSError, MemoryError)
"""What a user can mend: input, paths, a full disk, too little memory. Anything else is a fault of the program and keeps
its traceback."""
NO_MEMORY: Final = "can't allocate memory"
"""What torch says where Python and numpy raise MemoryError."""


def guarded(command: Callable[[], object]) -> int:
    """Runs a command and turns what a user can mend into one line `ballfg: error: ...` and an exit status.

    Args: command: takes no arguments; may raise.
    Returns: 0, 2 for bad input, 3 where some tracks could not be estimated, 130 after Ctrl-C, or the status that the
        command returned.
    """
    try:
        result = command()
    except typer.Exit as request:
        return request.exit_code
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted()
    except USER_ERRORS as error:
        if type(error).__name__ == "LinAlgError":  # numpy makes it a ValueError, but no user can mend it
            raise
        return _bad_input(_in_words(error))
    except Exception as error:
        # errors in the use of a command: typer's own base class has moved between versions, their method has not
        message, cause = getattr(error, "format_message", None), error.__context__
        if isinstance(cause, OSError) and cause.errno == errno.ELOOP:  # as `Path.resolve` has it before Python 3.13
            return _bad_input(_in_words(cause))
        if message is None and NO_MEMORY in str(error):
            return _bad_input(_in_words(MemoryError(f"torch {NO_MEMORY}")))
        if message is None:
            raise
        return _bad_input(message(), getattr(error, "ctx", None))
    if result == INTERRUPTED:
        return _interrupted()
    return result if isinstance(result, int) else 0


def check_words(words: Sequence[str]) -> None:
    """Refuses words of a command that no line of text can hold, names of files above all, before anything is done.

    Raises: UnicodeEncodeError.
    """
    for word in words:
        word.encode()


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
    text = "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in " ".join(message.split()))
    if len(text) > _LONGEST:
        text = f"{text[:_LONGEST]} ... ({len(text) - _LONGEST} characters more)"
    hint = "" if context is None else f" See '{context.command_path} --help'."
    print(f"ballfg: error: {text}{hint}", file=sys.stderr)
    return BAD_INPUT


def _interrupted() -> int:
    print("ballfg: interrupted", file=sys.stderr)
    return INTERRUPTED
