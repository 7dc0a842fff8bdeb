"""Running a user's Python file: an effect or a detector of one's own."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType


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
        exec(compile(path.read_bytes(), path, "exec"), module.__dict__)
    except Exception as error:  # whatever the user's code raises is the user's to mend
        raise ValueError(f"{path} must run as Python; {_where(error, path)}. Mend it there.") from error
    finally:
        del sys.modules[module.__name__]
    return module


def _where(error: Exception, path: Path) -> str:
    """What happened, and in which line of the file."""
    line = error.lineno if isinstance(error, SyntaxError) and error.filename == str(path) else None
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            line = trace.tb_lineno
        trace = trace.tb_next
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{'' if line is None else f'line {line}: '}{type(error).__name__}: {message}"
