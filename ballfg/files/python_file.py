"""Running a user's Python file: an effect or a detector of one's own."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import extract_tb
from types import ModuleType

from ballfg.interrupts import is_interrupt


def run_file(path: Path, what: str) -> ModuleType:
    """The module of a file, under a name that no import finds: worker processes then get its contents as a whole.

    Args:
        path: one that is trusted: all of its code runs.
        what: the file holds, for the module's name.
    Raises: ValueError: if it does not run; the message has the line.
    """
    module = ModuleType(f"ballfg {what} {path}")
    sys.modules[module.__name__] = module  # dataclasses look their module up
    try:
        with blamed(path, ""):
            exec(compile(path.read_bytes(), path, "exec"), module.__dict__)
    finally:
        del sys.modules[module.__name__]
    return module


@contextmanager
def blamed(path: Path, doing: str) -> Iterator[None]:
    """Turns whatever the user's code raises, which is the user's to mend, into one line.

    Args: path: of the file.  doing: what its code was asked for; empty while the file runs.
    Raises: ValueError: with the line.
    """
    try:
        yield
    except BaseException as error:  # one that leaves, by sys.exit or otherwise, would take the command with it
        if is_interrupt(error):
            raise
        during = f" ({doing})" if doing else ""
        raise ValueError(f"{path} must run as Python{during}; {_where(error, path)}. Mend it there.") from error


def _where(error: BaseException, path: Path) -> str:
    """What happened, and in which line of the file."""
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
    if not lines and isinstance(error, SyntaxError) and error.filename == str(path):
        lines = [error.lineno]
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{f'line {lines[-1]}: ' if lines else ''}{type(error).__name__}: {message}"
