"""Recordings grow under their own name, reach the disk within a second, and are never replaced or removed."""

import errno
import fcntl
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Self

from ballfg.files.json_file import parse_json
from ballfg.files.whole_file import check_file
from ballfg.live.outlook import KINDS, encoded

EVERY = 0.5  # s between two flushes to the disk
BLOCK = 65536  # Number of bytes of an earlier recording read at once; the first line is shorter
OPENING = b'{"kind":"'  # Beginning of each line


class Recording:
    """A file to which only this process appends. Use it as a context.

    Appended content survives a kill at once, and a power cut after half a second. A link is followed.

    Args:
        path: of the file; created if it does not exist.
        flush: appends pending content; a thread calls it twice a second.
    Attributes: size: number of whole bytes.
    Raises: FileNotFoundError: no such folder. ValueError: it is a folder or a device, or another process records to it.
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path, flush: Callable[[], None] | None = None) -> None:
        check_file(path)
        self.path = path
        self._flush = flush
        self._handle = os.open(os.path.realpath(path), os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            _lock(self._handle, path)
        except ValueError:
            os.close(self._handle)
            raise
        self.size = os.fstat(self._handle).st_size
        self._dirty = False
        self._error: OSError | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="ballfg live recording", daemon=True)
        self._thread.start()

    def read(self, offset: int, count: int) -> bytes:
        """Up to `count` bytes from an offset on."""
        return os.pread(self._handle, count, offset)

    def cut(self, size: int) -> None:
        """Cuts off the content after the first `size` bytes, an incomplete line or message."""
        os.ftruncate(self._handle, size)
        self.size = size

    def append(self, content: bytes) -> None:
        """Appends whole lines or messages. Raises: OSError: the disk refuses it; the earlier content stays whole."""
        self.check()
        done = 0
        try:
            while done < len(content):
                done += os.write(self._handle, memoryview(content)[done:])
        except OSError as error:
            self.cut(self.size)
            raise self._named(error) from None
        self.size += len(content)
        self._dirty = True

    def check(self) -> None:
        """Raises: OSError: the thread could not flush to the disk."""
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        try:
            self._bring_out()
        finally:
            os.close(self._handle)

    def _keep(self) -> None:
        while not self._stop.wait(EVERY):
            try:
                self._bring_out()
            except OSError as error:  # for the next `append`, in the thread that can end the command
                self._error = error
                return

    def _bring_out(self) -> None:
        if self._flush is not None:
            self._flush()
        if self._dirty:
            self._dirty = False
            try:
                os.fsync(self._handle)
            except OSError as error:
                if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some filesystems do it in their own way
                    raise self._named(error) from None

    def _named(self, error: OSError) -> OSError:
        return OSError(error.errno, error.strerror, str(self.path))


def lines_recording(path: Path, repeats: bool) -> Recording:
    """A recording of JSON lines, ready for the next line at its end.

    Args: path: of the file.  repeats: True if the input starts from its beginning again.
    Raises: ValueError: another kind of file, or the input repeats its content; and as `Recording`.
    """
    recording = Recording(path)
    try:
        if recording.size:
            if repeats:
                raise ValueError(
                    "out must be a new file for a replay or a file as input, which begin at their beginning again; "
                    f"{path} holds something. Choose another name, or remove it."
                )
            if not _is_ours(recording):
                raise ValueError(
                    f"out must be a new file or a recording of ballfg live to continue; {path} is neither. Choose "
                    "another name."
                )
            _cut_half_line(recording)
    except BaseException:
        recording.__exit__()
        raise
    if recording.size:
        recording.append(encoded({"kind": "continued"}, 0.0))
    return recording


def _is_ours(recording: Recording) -> bool:
    """True if the first line is one of `ballfg live`, or half of one if the command was killed at once."""
    first, ended, _ = recording.read(0, BLOCK).partition(b"\n")
    if not ended and recording.size < BLOCK:
        return first.startswith(OPENING) or OPENING.startswith(first)
    try:
        content = parse_json(first.decode())
    except ValueError:
        return False
    return isinstance(content, dict) and content.get("kind") in KINDS


def _cut_half_line(recording: Recording) -> None:
    """Cuts off the content after the last whole line, and tells the user that the recording is continued."""
    size = end = recording.size
    while end:
        begin = max(0, end - BLOCK)
        place = recording.read(begin, end - begin).rfind(b"\n")
        end = begin + place + 1 if place >= 0 else begin
        if place >= 0:
            break
    recording.cut(end)
    cut = size - end
    half = f"; {cut} bytes at its end, which a kill or a full disk had left incomplete, were cut off" if cut else ""
    print(f"ballfg live: continuing {recording.path}, which holds {end} bytes{half}", file=sys.stderr)


def _lock(handle: int, path: Path) -> None:
    """Locks a file until it is closed, except on a filesystem without locks. Raises: ValueError: it is locked."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ValueError(
            f"out must not be written twice at the same time; another process records to {path}. Choose another name."
        ) from None
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            raise
