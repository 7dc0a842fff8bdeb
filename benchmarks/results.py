"""Holds the rows of numbers of a benchmark, as in `results.json`."""

import json
import math
import platform
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ballfg.benchmarks.metrics import Figure
from ballfg.files.whole_file import write_text
from ballfg.machine import usable_cores, versions

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
    """All numbers of one run of a benchmark.

    Attributes: command: as typed, with a dataset's folder name in place of its path.  seed: random seed.
    """

    command: str
    seed: int
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
