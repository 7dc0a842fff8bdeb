"""A finished part of a long benchmark as a JSON file: whole or not there, and read only by runs that it belongs to."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from ballfg.files.whole_file import write_text

R = TypeVar("R")


def write_record(path: Path, content: Mapping[str, Any]) -> None:
    """Write the file; its name appears once it is whole. Raises: ValueError: if a number is not finite."""
    write_text(path, json.dumps(content, allow_nan=False) + "\n")


def read_record_file(path: Path, digest: str, build: Callable[[dict[str, Any]], R], what: str) -> R | None:
    """What `build` makes of a file's content; None if there is no file, or its `digest` is another.

    Args: what: the file should be, for instance `a finished run`.
    Raises: ValueError: if the file is none.
    """
    if not path.is_file():
        return None
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return None if content["digest"] != digest else build(content)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: must be {what} ({error!r}). Delete it, and it is run again.") from error
