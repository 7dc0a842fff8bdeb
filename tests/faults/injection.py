"""A file layer that fails: every call that changes files is counted, and one of them kills the process or raises.

Calls are counted below one folder only, so that caches elsewhere do not count.
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ballfg.files import whole_folder

KILL = 0
"""In place of an error's number."""
ROOM = ("mkdir", "open", "write", "fsync")
"""Calls that need room on the disk."""


@dataclass
class Faults:
    """What happens at which call.

    Attributes:
        root: only calls below it count.
        at: number of the call that fails, from 1; 0: none, all are counted.
        error: number of the error that it raises, or `KILL`.
        lasting: the later calls that need room on the disk fail too.
        calls: name and path of every counted call.
    """

    root: Path
    at: int = 0
    error: int = KILL
    lasting: bool = False
    calls: list[str] = field(default_factory=list)

    def install(self) -> None:
        """Replaces the calls in this process, for good: a process of its own should do it."""
        for name in ("replace", "rename", "mkdir", "unlink", "rmdir", "link", "fsync"):
            setattr(os, name, self._wrapped(name, getattr(os, name)))
        os.remove = os.unlink
        whole_folder.exchange = self._wrapped("exchange", whole_folder.exchange)
        real_open = os.open

        def created(path: Any, flags: int, *more: Any, **named: Any) -> int:
            if flags & os.O_CREAT:
                self.point("open", path, named.get("dir_fd"))
            return real_open(path, flags, *more, **named)

        os.open = created
        file_open = builtins.open

        def opened(file: Any, mode: str = "r", *more: Any, **named: Any) -> Any:
            if not set(mode) & set("wxa+") or isinstance(file, int) or not self._counts(file, None):
                return file_open(file, mode, *more, **named)
            self.point("open", file)
            return _File(file_open(file, mode, *more, **named), str(file), self)

        builtins.open = io.open = opened  # type: ignore[assignment]

    def point(self, name: str, path: Any, folder: int | None = None, torn: Callable[[], None] | None = None) -> None:
        """Counts a call, and fails if it is the one; `torn` does the half of it."""
        if not self._counts(path, folder):
            return
        self.calls.append(f"{name} {path}")
        later = self.lasting and name in ROOM and len(self.calls) > self.at
        if self.at and (len(self.calls) == self.at or later):
            if torn is not None:
                torn()
            if self.error == KILL:
                os.kill(os.getpid(), signal.SIGKILL)
            raise OSError(self.error, os.strerror(self.error), str(path))

    def _wrapped(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *more: Any, **named: Any) -> Any:
            self.point(name, path, named.get("dir_fd", named.get("src_dir_fd")))
            return real(path, *more, **named)

        return call

    def _counts(self, path: Any, folder: int | None) -> bool:
        if isinstance(path, int):
            path = os.readlink(f"/proc/self/fd/{path}")
        elif folder is not None:
            path = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), os.fspath(path))
        return str(self.root) in os.path.abspath(os.fsdecode(path))


class _File:
    """An open file whose `write` is a call that counts; half of the data is written before it fails."""

    def __init__(self, real: Any, path: str, faults: Faults) -> None:
        self._real, self._path, self._faults = real, path, faults

    def write(self, data: Any) -> int:
        def torn() -> None:
            self._real.write(data[: len(data) // 2])
            self._real.flush()

        self._faults.point("write", self._path, torn=torn)
        written: int = self._real.write(data)
        return written

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def __enter__(self) -> _File:
        self._real.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._real.__exit__(*exception)

    def __iter__(self) -> Any:
        return iter(self._real)


FULL = errno.ENOSPC
FORBIDDEN = errno.EACCES
