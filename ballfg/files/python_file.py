"""Runs a user's Python file with effects, observations or a detector."""

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
    """The module of a trusted file, under a name that no import finds. Raises: ValueError: with the line."""
    module = ModuleType(f"ballfg {what} {path}")
    sys.modules[module.__name__] = module  # dataclasses look their module up
    try:
        with blamed(path, ""):
            exec(compile(path.read_bytes(), path, "exec"), module.__dict__)
    finally:
        del sys.modules[module.__name__]
    return module


def load_classes(registry: Registry[T], path: str | Path) -> tuple[type[T], ...]:
    """Runs a Python file and registers its classes, except for names that begin with `_`.

    Args: registry: for classes of one kind.  path: of a file that you trust: all of its code runs.
    Returns: the classes, in the order in which they stand there.
    Raises: FileNotFoundError: if there is no such file. ValueError: if it is no Python, does not run, defines no such
        class, or one that the registry refuses.
    """
    path, sort = check_path("path", path).resolve(), registry.sort
    if path.is_dir():
        raise FileNotFoundError(f"{sort}s file must be one Python file; {path} is a folder. Give a file in it.")
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
    """The classes of a base that a module itself defines, in their order, except for abstract or private ones."""
    return [
        item
        for name, item in vars(module).items()
        if isinstance(item, type) and issubclass(item, base) and item.__module__ == module.__name__
        if name[0] != "_" and not isabstract(item)
    ]


@contextmanager
def blamed(path: Path, doing: str) -> Iterator[None]:
    """Turns any exception of the user's code into one line, with what it was doing. Raises: ValueError."""
    try:
        yield
    except BaseException as error:  # sys.exit in it would end the command
        if is_interrupt(error):
            raise
        during = f" ({doing})" if doing else ""
        raise ValueError(f"{path} must run as Python{during}; {_where(error, path)}. Mend it there.") from error


def _where(error: BaseException, path: Path) -> str:
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
    if not lines and isinstance(error, SyntaxError) and error.filename == str(path):
        lines = [error.lineno]
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{f'line {lines[-1]}: ' if lines else ''}{type(error).__name__}: {message}"
