"""Writing a file as a whole: it has its name only when it is complete."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path, argument: str = "out") -> Iterator[Path]:
    """A hidden path beside `path`, with its ending, to write to; it takes the name when the block ends well.

    After an exception or Ctrl-C what was there before is untouched.

    Raises: FileNotFoundError: the folder of the path does not exist. ValueError: the path is a folder.
    """
    check_file(path, argument)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield temporary
        flush(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


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


def check_file(path: Path, argument: str = "out") -> None:
    """Refuses a path to which no file can be written.

    Raises: FileNotFoundError: its folder does not exist. ValueError: it is a folder.
    """
    check_parent(path, argument)
    if path.is_dir():
        raise ValueError(f"{argument} must be a file; {path} is a folder. Give the name of a file in it.")


def check_parent(path: Path, argument: str) -> None:
    """Refuses a path in a folder that does not exist. Raises: FileNotFoundError."""
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{argument} must be in an existing folder; {path.parent} is none. Create it first.")
