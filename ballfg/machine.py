"""Describes the machine and the installed packages for results and runs; makes a process keep its memory longer."""

import ctypes
import gc
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import wraps
from importlib import metadata
from typing import Final, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

DATE: Final = "SOURCE_DATE_EPOCH"
"""Environment variable with a date in seconds since 1970 that replaces the present one, so that a page can be
reproduced byte for byte (reproducible-builds.org)."""

MOST_JOBS: Final = 10_000  # Largest number of processes; no machine has more cores


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of Python and of installed packages, by name."""
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in packages}


def date() -> str:
    """Today, as 2026-01-31 12:00 UTC."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(float(os.environ.get(DATE, time.time()))))


IMPORTED: Final = 1_000_000  # Number of objects before Python collects for the first time; its default is 700
MADE: Final = 50_000  # Growth in the number of objects before each later collection


def collect_rarely() -> None:
    """Lets a program's process collect garbage less often, and not before its imports are done.

    torch and similar packages create most of a million permanent objects. Scanning them again and again during their
    import takes a tenth of a command's start.
    """
    gc.set_threshold(IMPORTED, *gc.get_threshold()[1:])
    gc.callbacks.append(_after_imports)


TRIM_THRESHOLD: Final = (-1, 256 << 20)  # glibc's number of it, and the freed bytes beyond which it returns memory
MMAP_THRESHOLD: Final = (-3, 32 << 20)  # The same of the size of a block that is mapped by itself, at its largest


def keep_memory() -> None:
    """Lets a program's process keep up to 256 MiB of memory that it has freed, for its next arrays.

    Linux would map and clear every page of an array of a megabyte anew, which can take longer than the arithmetic.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # another libc
            for option in (MMAP_THRESHOLD, TRIM_THRESHOLD):
                ctypes.CDLL(None).mallopt(*option)


def _after_imports(phase: str, _info: dict[str, int]) -> None:
    """Python calls it at the first collection."""
    if phase == "stop":
        gc.callbacks.remove(_after_imports)
        gc.set_threshold(MADE, *gc.get_threshold()[1:])


def collecting_later(function: Callable[P, R]) -> Callable[P, R]:
    """A function during which Python collects no garbage; a collection that falls due waits for its end.

    Where collection is off, it stays off. Other threads collect nothing in this time either.
    """

    @wraps(function)
    def without_collection(*args: P.args, **kwargs: P.kwargs) -> R:
        if not gc.isenabled():
            return function(*args, **kwargs)
        gc.disable()
        try:
            return function(*args, **kwargs)
        finally:
            gc.enable()

    return without_collection
