"""Running a user's Python file: effects, observations or a detector of one's own."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from inspect import isabstract
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Any, TypeVar

from ballfg.checks import check_path
from ballfg.interrupts import is_interrupt
from ballfg.registry import Registry

T = TypeVar("T")


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


def load_classes(registry: Registry[T], path: str | Path) -> tuple[type[T], ...]:
    """Run a Python file and register the classes that it defines; those that begin with `_` are left out.

    Args: registry: decides which classes it takes.  path: of a file that you trust: all of its code runs.
    Returns: the classes, in the order in which they stand there.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no Python, does not run, defines no such class, or one that the registry refuses.
    """
    path, sort = check_path("path", path).resolve(), registry.sort
    if not path.is_file():
        raise FileNotFoundError(f"{sort}s file {path} does not exist; {sort}s of one's own are one Python file.")
    own = defined_classes(run_file(path, f"{sort}s"), registry.base)
    if not own:
        article = "an" if sort[0] in "aeiou" else "a"
        raise ValueError(f"{path} must define {article} {sort}, a class; it defines none. {registry.remedy}")
    try:
        return tuple(registry.register(cls) for cls in own)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def defined_classes(module: ModuleType, base: type[Any] | tuple[type[Any], ...]) -> list[type[Any]]:
    """The classes of a base that a module defines itself, in their order; not those that are abstract or private."""
    return [
        item
        for name, item in vars(module).items()
        if isinstance(item, type) and issubclass(item, base) and item.__module__ == module.__name__
        if name[0] != "_" and not isabstract(item)
    ]


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
