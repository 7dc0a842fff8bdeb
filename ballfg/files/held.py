"""Locks a result in the user's state folder while it is made in a hidden folder of a random name.

The kernel frees the lock when its process ends, however it ends. The next writer of the same result clears the remains
of a killed process, as listed in the lock's file, which only this user can write: files beside it are not trusted.
"""

import errno
import hashlib
import json
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final

from ballfg.files.own_folder import PRIVATE, state_folder

MARK: Final = ".ballfg-"  # prefix of the names of hidden folders
NEW, OLD = "new", "old"  # entries of a hidden folder: the new folder, and the one that it replaces
PATIENCE: Final = 0.3  # s after which a lock counts as that of a writer
_DISK: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
_records: ContextVar[dict[Path, Path | None]] = ContextVar("records")
"""Results and hidden folders that this line of work holds: the files of the locks, None for a result that could not be
locked. Another thread has none."""


@contextmanager
def held(target: Path, argument: str = "out") -> Iterator[None]:
    """Keeps other processes of this user from writing a result until the block ends; its holder may hold it again.

    If the state folder supports no locks or is full, nothing is locked, and nothing cleared.

    Args: target: the file or folder, without links.  argument: its name, for the message.
    Raises: ValueError: another process, or another thread, writes it.
    """
    if target in _records.get({}):
        yield
        return
    from filelock import FileLock, Timeout

    record = state_folder("locks") / hashlib.sha256(os.fsencode(target)).hexdigest()[:32]
    lock = FileLock(record, fallback_to_soft=False)
    try:
        lock.acquire(timeout=PATIENCE, poll_interval=0.01)
    except Timeout:
        process = next(iter(_read(record)), "(just starting)")
        raise ValueError(
            f"{argument} must not be written twice at the same time; {target} is being written by process {process}. "
            "Wait for it, or choose another name."
        ) from None
    except OSError:
        pass  # no locks or no room there
    if not lock.is_locked:
        with _holding(target, None):
            yield
        return
    try:
        for place in _left(record):  # the remains of a killed process; a folder that it had moved gets its name back
            with suppress(OSError):
                if (place / OLD).is_dir() and not os.path.lexists(target):
                    os.rename(place / OLD, target)
            _remove(place)
        _write(record, os.getpid(), "w")
        with _holding(target, record):
            yield
    finally:
        if not _left(record):
            record.unlink(missing_ok=True)  # while it is locked: a waiting process then makes a new one
        lock.release()


@contextmanager
def hidden(parent: Path, target: Path, path: Path) -> Iterator[Path]:
    """A new folder in `parent` for this user alone, removed at the end; errors of the disk name `path`."""
    place, record = parent / f"{MARK}{secrets.token_hex(8)}", _records.get()[target]
    if record is not None:
        _write(record, str(place))
    try:
        place.mkdir(PRIVATE)
        with _holding(place, record):
            yield place
    except OSError as error:
        if error.errno is None or not (MARK in str(error.filename) or (not error.filename and error.errno in _DISK)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        _remove(place)


def is_hidden(path: Path) -> bool:
    """True for a path in a hidden folder of this line of work, which is no result yet."""
    return any(each.name.startswith(MARK) for each in _records.get({}).keys() & {*path.parents})


@contextmanager
def _holding(path: Path, record: Path | None) -> Iterator[None]:
    _records.set(_records.get({}) | {path: record})
    try:
        yield
    finally:
        _records.set({each: its for each, its in _records.get().items() if each != path})


def _write(record: Path, line: int | str, mode: str = "a") -> None:
    """Adds a line: the process, then each hidden folder before it is made."""
    with suppress(OSError), record.open(mode, encoding="utf-8") as file:  # without room, nothing will be cleared
        file.write(json.dumps(line) + "\n")


def _read(record: Path) -> Iterator[Any]:
    """The whole lines. If the last one was cut, its folder was not made yet."""
    with suppress(OSError, ValueError), record.open(encoding="utf-8") as file:
        yield from map(json.loads, file)


def _left(record: Path) -> list[Path]:
    """The existing hidden folders that belong to this user."""
    places = [Path(line) for line in _read(record) if isinstance(line, str) and os.path.lexists(line)]
    found = ((place, place.lstat()) for place in places)
    return [place for place, one in found if stat.S_ISDIR(one.st_mode) and one.st_uid == os.geteuid()]


def _remove(place: Path) -> None:
    for folder, _, _ in os.walk(place):
        os.chmod(folder, PRIVATE)  # a read-only folder does not let anything be removed
    shutil.rmtree(place, ignore_errors=True)
