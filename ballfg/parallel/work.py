"""A function of a chunk: pickled once, computed wherever its chunks arrive."""

import hashlib
import pickle
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from threading import Lock
from typing import Any, TypeVar

from cloudpickle import dumps

from ballfg.parallel.same_versions import differences

T = TypeVar("T")
R = TypeVar("R")

KEPT = 4
"""Functions that a worker keeps. What one of them loads - a model, machine code - then serves all of its chunks."""

_INSIDE: ContextVar[bool] = ContextVar("inside", default=False)
_functions: OrderedDict[str, Callable[..., Any]] = OrderedDict()
_one_at_a_time = Lock()


@dataclass(frozen=True)
class Work:
    """A pickled function of a chunk. `name` is the digest of `content`, by which workers know it again."""

    name: str
    content: bytes

    @classmethod
    def of(cls, function: Callable[..., Any]) -> "Work":
        """The work of a function; what no worker could import, such as a user's effects, is in it as a whole."""
        content = packed(function)
        return cls(hashlib.sha256(content).hexdigest()[:16], content)


def packed(thing: object) -> bytes:
    """A thing pickled, with functions and classes that cannot be imported by name as a whole."""
    return bytes(dumps(thing))


def compute(name: str, content: bytes, chunk: bytes, versions: dict[str, str]) -> bytes:
    """What a worker does: the pickled result of a function of a chunk.

    One chunk at a time is computed in a process, on one thread; whatever it shares out itself stays in this process.

    Args: name, content: of the `Work`.  chunk: pickled.  versions: of the process that asks.
    Raises: ValueError: the versions differ from those of this process; and what the function raises.
    """
    different = differences(versions)
    if different:
        raise ValueError(different)
    with _one_at_a_time:
        return packed(alone(_function(name, content), pickle.loads(chunk)))


def each(function: Callable[[Any], R], chunk: Sequence[Any]) -> list[R]:
    """A function of each item of a chunk."""
    return [function(item) for item in chunk]


def on_one_thread(function: Callable[[T], R], argument: T) -> R:
    """What a function gives, computed on one torch thread."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the processes share the cores already; and sums over threads differ in their last bits
    try:
        return function(argument)
    finally:
        torch.set_num_threads(threads)


def alone(function: Callable[[T], R], argument: T) -> R:
    """What a function gives, computed on one torch thread; nothing in it starts processes of its own."""
    token = _INSIDE.set(True)
    try:
        return on_one_thread(function, argument)
    finally:
        _INSIDE.reset(token)


def is_inside() -> bool:
    """Whether this code runs as part of a chunk."""
    return _INSIDE.get()


def _function(name: str, content: bytes) -> Callable[..., Any]:
    if name not in _functions:
        _functions[name] = pickle.loads(content)
        while len(_functions) > KEPT:
            _functions.popitem(last=False)
    _functions.move_to_end(name)
    return _functions[name]
