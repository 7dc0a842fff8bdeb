"""Pickles a function of chunks once and computes it wherever its chunks arrive."""

import hashlib
import pickle
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from importlib import import_module
from threading import Lock
from typing import Any, TypeVar

from cloudpickle import dumps

from ballfg.deferred import one_thread
from ballfg.parallel.same_versions import differences

T = TypeVar("T")
R = TypeVar("R")

KEPT = 4  # Number of functions that a worker keeps. Their models and machine code then serve all of their chunks.
_INSIDE: ContextVar[bool] = ContextVar("inside", default=False)
_functions: OrderedDict[str, Callable[..., Any]] = OrderedDict()
_one_at_a_time = Lock()


@dataclass(frozen=True)
class Work:
    """A pickled function of a chunk. `name` is the digest of `content`, by which workers recognise it."""

    name: str
    content: bytes

    @classmethod
    def of(cls, function: Callable[..., Any]) -> "Work":
        """The work of a function; it includes code that workers cannot import, such as a user's effects."""
        content = packed(function)
        return cls(hashlib.sha256(content).hexdigest()[:16], content)


def packed(thing: object) -> bytes:
    """A pickled object, including functions and classes that cannot be imported by name."""
    return bytes(dumps(thing))


def compute(name: str, content: bytes, chunk: bytes | None, versions: dict[str, str]) -> bytes:
    """Computes a chunk in a worker: the pickled result of the function.

    A process computes one chunk at a time, on one thread; nested work stays in this process.

    Args: name, content: of the `Work`.  chunk: pickled; None only loads the function.  versions: of the caller.
    Raises: ValueError: the versions differ from those of this process; and the function's exceptions.
    """
    if different := differences(versions):
        raise ValueError(different)
    with _one_at_a_time:
        function = _functions.pop(name) if name in _functions else pickle.loads(content)
        _functions[name] = function  # the last one used stands last
        while len(_functions) > KEPT:
            _functions.popitem(last=False)
        return packed(None if chunk is None else alone(function, pickle.loads(chunk)))


def too_many_deaths(cluster: str, first: str) -> ChildProcessError:
    """The error for a chunk whose workers died."""
    problem = f"workers must live while they work; {cluster} lost too many over a chunk that begins with {first}"
    return ChildProcessError(f"{problem}. Memory is probably short: give workers more of it.")


def each(function: Callable[[Any], R], chunk: Sequence[Any]) -> list[R]:
    """A function of each item of a chunk."""
    return [function(item) for item in chunk]


def loaded(modules: Sequence[str]) -> None:
    """Imports modules by their names."""
    for name in modules:
        import_module(name)


def on_one_thread(function: Callable[[T], R], argument: T) -> R:
    """A function's result, computed on one torch thread."""
    with one_thread():  # the processes share the cores already; and sums over threads differ in their last bits
        return function(argument)


def alone(function: Callable[[T], R], argument: T) -> R:
    """A function's result, computed on one torch thread without further processes."""
    token = _INSIDE.set(True)
    try:
        return on_one_thread(function, argument)
    finally:
        _INSIDE.reset(token)


def is_inside() -> bool:
    """True if this code runs as part of a chunk."""
    return _INSIDE.get()
