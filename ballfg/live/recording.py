"""Recordings: files that grow under their own name, are soon on the disk, and are never replaced or removed."""

from __future__ import annotations

import errno
import fcntl
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from ballfg.files.json_file import parse_json
from ballfg.files.whole_file import check_file
from ballfg.live.answers import KINDS, encoded

EVERY = 0.5
"""s between two times at which what was recorded is brought to the disk: what was read a second ago is there."""
BLOCK = 65536
"""Bytes read at once of what an earlier command has recorded; the first line is shorter."""
OPENING = b'{"kind":"'
"""How each line begins."""


class Recording:
    """A file to which this process appends, and no other one meanwhile. Use it as a context.

    What was appended survives a kill at once, and a power cut after half a second. A link is written to where it leads.

    Args:
        path: of the file; it is made if it does not exist.
        flush: appends what is held back; a thread calls it twice a second.
    Attributes:
        size: bytes that are whole.
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
        """Cut off what follows the first `size` bytes, because it is no whole line or message."""
        os.ftruncate(self._handle, size)
        self.size = size

    def append(self, content: bytes) -> None:
        """Append whole lines or messages. Raises: OSError: the disk refuses it; what was there before stays whole."""
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
        """Raises: OSError: the thread could not bring something to the disk."""
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        try:
            self._bring_out()
        finally:
            os.close(self._handle)

    def _keep(self) -> None:
        """The thread that brings everything to the disk."""
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
                if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a filesystem that does it in its own way
                    raise self._named(error) from None

    def _named(self, error: OSError) -> OSError:
        return OSError(error.errno, error.strerror, str(self.path))


def lines_recording(path: Path, repeats: bool) -> Recording:
    """A recording of JSON lines, at whose end the next line belongs.

    Args: path: of the file.  repeats: the input begins at its beginning again.
    Raises: ValueError: it is no recording, or the input repeats what is in it; and as `Recording`.
    """
    recording = Recording(path)
    try:
        if recording.size:
            refuse_repeated(path, repeats)
            _check_lines(recording)
            _cut_half_line(recording)
    except BaseException:
        recording.__exit__()
        raise
    if recording.size:
        recording.append(encoded({"kind": "continued"}, 0.0))
    return recording


def refuse_repeated(path: Path, repeats: bool) -> None:
    """Refuse a file that is there, if the input begins at its beginning again. Raises: ValueError."""
    if repeats:
        raise ValueError(
            f"out must be a new file for a replay or a file as input, which begin at their beginning again; {path} "
            "holds something. Choose another name, or remove it."
        )


def refused(path: Path) -> ValueError:
    """The error for a file that is something else."""
    return ValueError(
        f"out must be a new file or a recording of ballfg live to continue; {path} is neither. Choose another name."
    )


def say_continued(path: Path, size: int, cut: int) -> None:
    """Tell the user that a recording is continued. Args: size, cut: bytes that stay, and that were cut off."""
    half = f"; {cut} bytes at its end, which a kill or a full disk had left incomplete, were cut off" if cut else ""
    print(f"ballfg live: continuing {path}, which holds {size} bytes{half}", file=sys.stderr)


def _check_lines(recording: Recording) -> None:
    """Refuse a file whose first line is none of `ballfg live`. Raises: ValueError."""
    first, ended, _ = recording.read(0, BLOCK).partition(b"\n")
    if not ended and recording.size < BLOCK:  # a half line, of a command that was killed at once
        if not (first.startswith(OPENING) or OPENING.startswith(first)):
            raise refused(recording.path)
        return
    try:
        content = parse_json(first.decode())
    except ValueError:
        raise refused(recording.path) from None
    if not isinstance(content, dict) or content.get("kind") not in KINDS:
        raise refused(recording.path)


def _cut_half_line(recording: Recording) -> None:
    """Cut off what follows the last whole line."""
    size = end = recording.size
    while end:
        begin = max(0, end - BLOCK)
        place = recording.read(begin, end - begin).rfind(b"\n")
        if place >= 0:
            end = begin + place + 1
            break
        end = begin
    recording.cut(end)
    say_continued(recording.path, end, size - end)


def _lock(handle: int, path: Path) -> None:
    """Lock a file until it is closed; a filesystem without locks is used without. Raises: ValueError: it is locked."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ValueError(
            f"out must not be written twice at the same time; another process records to {path}. Choose another name."
        ) from None
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            raise
