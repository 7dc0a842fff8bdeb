"""Writing a file as a whole: it has its name only when it is complete."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ballfg.files.held import NEW, beside, clear, held


@contextmanager
def whole_file(path: Path, argument: str = "out") -> Iterator[Path]:
    """A path in a hidden folder, with the same name, to write to; it takes its place when the block ends well.

    After an exception, Ctrl-C or a kill what was there before is untouched.

    Raises: FileNotFoundError: the folder of the path does not exist. ValueError: the path is a folder or a device, or
        another process is writing it.
    """
    check_file(path, argument)
    target = Path(os.path.realpath(path.parent)) / path.name
    place = beside(target)
    with held(place, path, argument):
        try:
            (place / NEW).mkdir()
            temporary = place / NEW / path.name
            yield temporary
            flush(temporary)
            os.replace(temporary, target)
            flush_folder(target.parent)
        finally:
            clear(place)


def write_text(path: Path, text: str) -> None:
    """Writes a text file in UTF-8 as a whole. Raises: as `whole_file`."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def flush(path: Path) -> None:
    """Brings a file to the disk, so that a power cut does not leave a name without content."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def flush_folder(path: Path) -> None:
    """Brings the names in a folder to the disk; a filesystem that has no such call (EINVAL) does it in its own way."""
    try:
        flush(path)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise


def check_file(path: Path, argument: str = "out") -> None:
    """Refuses a path to which no file can be written.

    Raises: FileNotFoundError: its folder does not exist. ValueError: it is a folder, or a device such as /dev/null,
        whose place a file would take.
    """
    check_parent(path, argument)
    if path.is_dir():
        raise ValueError(f"{argument} must be a file; {path} is a folder. Give the name of a file in it.")
    if path.exists() and not path.is_file():
        raise ValueError(f"{argument} must be a file; {path} is a device or a pipe. Give the name of a file.")


def check_parent(path: Path, argument: str) -> None:
    """Refuses a path in a folder that does not exist. Raises: FileNotFoundError."""
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{argument} must be in an existing folder; {path.parent} is none. Create it first.")
