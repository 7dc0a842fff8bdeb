"""One process at a time writes a result: the hidden folder in which the result is made holds a lock.

The kernel frees the lock when the process ends, however it ends. What a killed process left is cleared by the next one
that writes the same result.
"""

import errno
import fcntl
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Final

MARK: Final = ".ballfg-writing"
"""Name of the hidden folder in which a result is made, or the end of its name."""
NEW: Final = "new"
"""In it: what is being made."""
OLD: Final = "old"
"""In it: what has been replaced."""
PLAN: Final = "plan.json"
"""In it: what moves where. While this file exists, a result is between its old and its new state."""
LOCK: Final = "lock"
"""In it: the file that is locked; it holds the number of the process."""
PATIENCE: Final = 0.3
"""s after which a lock counts as that of a writer."""

_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())
"""Hidden folders that this line of work has locked. Another thread has an empty set, and is refused."""


class BeingWrittenError(ValueError):
    """Another process, or another thread, is writing the same result."""


def beside(path: Path) -> Path:
    """The hidden folder of a file, or of a folder that does not exist yet."""
    return path.with_name(f".{path.name}{MARK}")


@contextmanager
def held(place: Path, target: Path, argument: str = "out") -> Iterator[None]:
    """Locks a hidden folder until the block ends; who holds it already may lock it again.

    Args:
        place: the hidden folder; it is made, and removed at the end unless an unfinished plan is in it.
        target: what is written, for the message.
        argument: its name, for the message.
    Raises: BeingWrittenError: another process writes there. OSError: the folder cannot be made.
    """
    if place in _held.get():
        yield
        return
    handle = _locked(place, target, argument)
    _held.set(_held.get() | {place})
    try:
        if not (place / PLAN).exists():
            clear(place)
        yield
    finally:
        _held.set(_held.get() - {place})
        _release(place, handle)


def clear(place: Path) -> None:
    """Removes what was made and what was replaced."""
    for name in (NEW, OLD):
        shutil.rmtree(place / name, ignore_errors=True)


def _locked(place: Path, target: Path, argument: str) -> int:
    """The handle of the locked file. The folder may be removed by another process at any moment before that."""
    begun = time.monotonic()
    while True:
        try:
            place.mkdir(exist_ok=True)
            handle = os.open(place / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:
            if not place.parent.is_dir():
                raise
            continue
        try:
            _lock(handle)
            if _is_same(handle, place / LOCK):
                os.ftruncate(handle, 0)
                os.write(handle, str(os.getpid()).encode())
                return handle
        except BlockingIOError:
            if time.monotonic() - begun < PATIENCE:  # whoever clears up holds it for an instant
                os.close(handle)
                time.sleep(0.01)
                continue
            process = os.pread(handle, 32, 0).decode(errors="replace").strip()
            os.close(handle)
            raise BeingWrittenError(
                f"{argument} must not be written twice at the same time; {target} is being written by process "
                f"{process or '(just starting)'}. Wait for it, or choose another name."
            ) from None
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _lock(handle: int) -> None:
    """Locks a file; a filesystem without locks (some network disks) is used without. Raises: BlockingIOError."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            raise


def _is_same(handle: int, path: Path) -> bool:
    """Whether the file that is open still has its name: its last holder removes it."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False


def _release(place: Path, handle: int) -> None:
    """Removes the folder before the lock is freed, unless something in it is still needed."""
    try:
        if not (place / PLAN).exists():
            (place / LOCK).unlink(missing_ok=True)
            place.rmdir()
    except OSError:
        pass  # another process is about to lock it, or the disk refuses: a folder that is left over harms nobody
    finally:
        os.close(handle)
