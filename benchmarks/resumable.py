"""Resumes long runs: keeps records of finished parts, and computes the missing ones in processes."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from pydantic import TypeAdapter

from ballfg.checks import one_line, short_text
from ballfg.files.json_file import read_json
from ballfg.files.whole_file import write_text
from ballfg.parallel.executor import executor
from ballfg.parallel.stream import finished
from ballfg.parallel.work import on_one_thread
from ballfg.progress import progress

T = TypeVar("T")
R = TypeVar("R")

RUNS_FOLDER = "runs"  # Folder in a benchmark's output with a JSON file for each finished part


def in_processes(work: Callable[[T], R], items: Sequence[T], jobs: int, what: str) -> list[R]:
    """The results of some work in the order of the items; `what` is finished stands in the progress lines.

    On a cluster they are made by its workers; one process stays in this one.
    """
    others = executor(min(jobs, len(items)), helped=False) if jobs > 1 else None
    if others is None:
        found: Iterator[tuple[int, R]] = ((number, on_one_thread(work, item)) for number, item in enumerate(items))
    else:
        found = finished(work, items, others)
    return [result for _, result in sorted(progress(found, len(items), what), key=lambda pair: pair[0])]


def collect(
    items: Sequence[T], read: Callable[[T], R | None], make: Callable[[T], R | None], jobs: int, what: str
) -> list[R | None]:
    """The record of each item: read where it is finished, else made in a process; None where that failed."""
    found = [read(item) for item in items]
    missing = [place for place, record in enumerate(found) if record is None]
    made = in_processes(make, [items[place] for place in missing], jobs, what)
    for place, record in zip(missing, made, strict=True):
        found[place] = record
    return found


@dataclass(frozen=True)
class Kept:
    """What is kept of a finished part, as a JSON file. `digest`: of its settings; a record of others does not count."""

    what: ClassVar[str] = "a finished case"  # In messages
    digest: str

    def save(self, path: Path) -> None:
        """Write the file whole or not at all. Raises: ValueError: if a number is not finite."""
        write_text(path, json.dumps(asdict(self), allow_nan=False) + "\n")

    @classmethod
    def read(cls, path: Path, digest: str) -> Self | None:
        """The record in a file; None if there is no file, or its `digest` is another."""
        if not path.is_file():
            return None
        try:
            content: dict[str, Any] = read_json(path)
            return None if content["digest"] != digest else TypeAdapter(cls).validate_python(content)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            reason = short_text(f"{type(error).__name__}: {one_line(error)}")
            raise ValueError(f"{path}: must be {cls.what} ({reason}). Delete it, and it is run again.") from error
