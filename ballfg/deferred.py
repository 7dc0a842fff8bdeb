"""Gives torch, whose import takes a second, at its first use: estimates of a ball with machine code need none."""

import importlib
import os
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any


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
    os.environ["OMP_NUM_THREADS"] = "1"  # which it reads then
    if "torch" in sys.modules:
        torch.set_num_threads(1)
