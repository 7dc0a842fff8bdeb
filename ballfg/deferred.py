"""Gives torch, whose import takes a second, at its first use: estimates of a ball with machine code need none."""

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

from ballfg.machine import usable_cores

THREADS: Final = "OMP_NUM_THREADS"


class _Deferred(ModuleType):
    """A module that is imported when something of it is asked for the first time."""

    def __getattr__(self, name: str) -> Any:
        value = getattr(importlib.import_module(self.__name__), name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import torch as torch
else:
    torch = _Deferred("torch")


def on_one_thread() -> None:
    """Lets torch compute on one thread, whenever it is imported: threads cost small batches more than they save."""
    os.environ[THREADS] = "1"  # which it reads then
    if "torch" in sys.modules:
        torch.set_num_threads(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Within it torch computes on one thread, also if it is imported meanwhile."""
    if "torch" in sys.modules:
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)
        return
    stated = os.environ.get(THREADS)
    os.environ[THREADS] = "1"
    try:
        yield
    finally:
        os.environ.pop(THREADS, None)  # threads may share this
        if stated is not None:
            os.environ[THREADS] = stated
        if "torch" in sys.modules:
            torch.set_num_threads(int(stated) if stated and stated.isdecimal() else usable_cores())
