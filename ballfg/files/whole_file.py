"""Writing a file as a whole: it has its name only when it is complete."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden path beside `path`, with its ending, to write to; it takes the name when the block ends well.

    After an exception or Ctrl-C what was there before is untouched.

    Raises: FileNotFoundError: the folder of the path does not exist. ValueError: the path is a folder.
    """
    check_writable(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Refuses a path to which no file can be written; errors as those of `whole_file`."""
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"out must be in an existing folder; {path.parent} is none. Create it first.")
    if path.is_dir():
        raise ValueError(f"out must be a file; {path} is a folder. Give the name of a file in it.")
