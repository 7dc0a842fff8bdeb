"""Reading several files of a folder that a writer may exchange for a new one meanwhile."""

import os
from collections.abc import Callable
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Final, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_TRIES: Final = 20
_OPEN: Final = os.O_DIRECTORY | getattr(os, "O_PATH", os.O_RDONLY)


def of_one_state(read: Callable[P, T]) -> Callable[P, T]:
    """A reader that reads again where its folder was exchanged meanwhile, so that all files are of one result.

    Args: read: its first argument is the folder, or a file in it.
    """

    @wraps(read)
    def steady(*args: P.args, **kwargs: P.kwargs) -> T:
        path = next(iter(signature(read).bind(*args, **kwargs).args), None)
        if not isinstance(path, str | os.PathLike) or not os.path.exists(path):
            return read(*args, **kwargs)
        folder = Path(path) if os.path.isdir(path) else Path(path).parent
        left = _TRIES
        while True:
            left -= 1
            before = os.open(folder, _OPEN)  # while it is open, no other folder gets its number
            try:
                result = read(*args, **kwargs)
                if _is_at(folder, before) or not left:
                    return result
            except (OSError, ValueError):
                if _is_at(folder, before) or not left:
                    raise
            finally:
                os.close(before)

    return steady


def _is_at(folder: Path, opened: int) -> bool:
    return folder.is_dir() and os.path.samestat(os.fstat(opened), folder.stat())
