"""Holds the rows of numbers of a benchmark, as in `results.json`, and keeps finished parts of long runs."""

import json
import math
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from pydantic import TypeAdapter

from ballfg.benchmarks.metrics import Figure
from ballfg.checks import one_line, short_text
from ballfg.files.json_file import read_json
from ballfg.files.whole_file import write_text
from ballfg.machine import usable_cores, versions
from ballfg.parallel.executor import executor
from ballfg.parallel.stream import finished
from ballfg.parallel.work import on_one_thread
from ballfg.progress import progress

PACKAGES = ("ballfg", "gtsam", "torch", "numpy", "scipy", "filterpy")
"""Packages whose versions, like Python's, influence the numbers."""
RESULTS_FILE = "results.json"
CURVE_MARK = "@"
"""In a metric's name before the place on a curve, as in `velocity_rmse_newest@20`: pictures show it, tables do not."""


@dataclass(frozen=True)
class Row:
    """One number.

    Attributes:
        case: names the data (`paper`, `fair`, `aimy` ...).
        method: names the estimator, model or part (`smoother`, `ekf` ...).  metric: names the quantity.
        unit: SI or a multiple, or `1` for none.  value: None where it is not finite.
        low, high: ends of its interval, None where it has none.
        n: number of tracks, samples or runs; docs/benchmarks.md says which for each metric.
    """

    case: str
    method: str
    metric: str
    unit: str
    value: float | None
    low: float | None
    high: float | None
    n: int


@dataclass
class Results:
    """All numbers of one run of a benchmark."""

    command: str  # as typed, with a dataset's folder name in place of its path
    seed: int  # random seed
    rows: list[Row] = field(default_factory=list)

    def add(self, case: str, method: str, metric: str, unit: str, value: float | Figure, n: int) -> None:
        """Add a number; a `Figure` brings its interval."""
        figure = value if isinstance(value, Figure) else Figure(float(value), math.nan, math.nan)
        ends = _finite(figure.low), _finite(figure.high)
        self.rows.append(Row(case, method, metric, unit, _finite(figure.value), *ends, int(n)))

    def value(self, case: str, method: str, metric: str) -> float | None:
        """The value of a row. Raises: KeyError: if there is no such row."""
        for row in self.rows:
            if (row.case, row.method, row.metric) == (case, method, metric):
                return row.value
        raise KeyError(f"no row ({case}, {method}, {metric})")

    def to_dict(self) -> dict[str, Any]:
        """The content of `results.json`."""
        origin = {"command": self.command, "versions": versions(PACKAGES), "machine": machine(), "seed": self.seed}
        return {**origin, "rows": [asdict(row) for row in self.rows]}

    def write(self, folder: Path) -> Path:
        """Write `results.json` whole or not at all."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / RESULTS_FILE
        write_text(path, json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n")
        return path


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def machine() -> dict[str, Any]:
    """Processor, usable cores and system; nothing that identifies a user's machine."""
    cpu = platform.processor() or "unknown"
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), cpu)
    return {"cpu": cpu, "cores": usable_cores(), "system": f"{platform.system()} {platform.machine()}"}


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
