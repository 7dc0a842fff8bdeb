"""Measures times of warm, repeated runs next to a control, and compares them with those of an earlier run."""

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import TypeAdapter

from ballfg.benchmarks.metrics import Figure, median_and_quartiles
from ballfg.benchmarks.results import Results, Row
from ballfg.benchmarks.speed.banded import BandedProblem
from ballfg.checks import one_line, short_text
from ballfg.files.json_file import read_json

CONTROL_SIZE = 512  # Size of the square float64 matrices whose product is the control


def milliseconds(action: Callable[[], object]) -> float:
    """Time of one call."""
    start = time.perf_counter()
    action()
    return 1e3 * (time.perf_counter() - start)


@dataclass(frozen=True)
class Stopwatch:
    """Times actions and adds their rows."""

    results: Results  # gets the rows
    case: str  # of all of them
    runs: int  # timed ones
    warm_up: int  # runs before them, not counted
    banded: BandedProblem  # the problem that the control solves

    def time(self, method: str, metric: str, action: Callable[[], object]) -> Figure:
        """Median and quartiles of an action's time, ms; adds them as a row."""
        for _ in range(self.warm_up):
            action()
        gc.collect()
        figure = median_and_quartiles([milliseconds(action) for _ in range(self.runs)])
        self.results.add(self.case, method, metric, "ms", figure, self.runs)
        return figure

    def add(self, method: str, metric: str, value: float, n: int = 1) -> None:
        """Add a row without unit."""
        self.results.add(self.case, method, metric, "1", value, n)

    def control(self, method: str) -> None:
        """Time one fixed matrix product, and a solver that is bound by Python's own speed."""
        a, b = np.random.default_rng(0).standard_normal((2, CONTROL_SIZE, CONTROL_SIZE))
        self.time(method, "matrix_product_time", lambda: a @ b)
        self.time(method, "banded_time", self.banded.solve)


CONTROL: Final = "banded_time"  # Bound by Python's own speed, as the estimators are
RARE: Final = ("_p99", "_p999", "_worst")
"""Ends of metrics of the slowest runs, which other work on the machine decides."""
UNSTEADY: Final = ("matrix", "stream")
"""Beginnings of metrics that differ by a third from run to run: of the other control, and of long streams, which depend
on what the caches hold. So does the unrolled gradient, a reference."""
SLOWER: Final = 1.3
"""Multiple of the earlier ratio from which on something has become slower; runs of the same code differ by 1.1."""
_ROWS: Final = TypeAdapter(list[Row])


class SlowerError(Exception):
    """An action takes longer than it did."""


def check_ratios(rows: Sequence[Row], baseline: Path) -> list[str]:
    """One line for each time of the baseline: its ratio to the control then and now.

    Args: baseline: the `results.json` of an earlier run.
    """
    try:
        earlier = _ROWS.validate_python(read_json(baseline)["rows"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"--gate must be the results.json of an earlier `ballfg-bench speed`; {baseline} is none "
            f"({short_text(one_line(error))})."
        ) from error
    before, now = _ratios(earlier), _ratios(rows)
    shared = [key for key in before if key in now]
    if not shared:
        raise ValueError(f"--gate must hold times beside a control, as this run has; {baseline} shares none with it.")
    lines, slower = [], []
    for key in shared:
        grown = now[key] / before[key]
        lines.append(f"{' '.join(key)}: {now[key]:.3g} times the control, {before[key]:.3g} before ({grown:.2f})")
        if grown > SLOWER:
            slower.append(lines[-1])
    if slower:
        raise SlowerError("slower than the baseline:\n" + "\n".join(slower))
    return lines


def _ratios(rows: Sequence[Row]) -> dict[tuple[str, str, str], float]:
    """Times over the control of the same case, by case, method and metric."""
    controls, found = dict[str, float](), dict[tuple[str, str, str], float]()
    timed = [(row, row.value) for row in rows if row.value is not None and 1e-9 < row.value < 1e9]  # ps to ten days
    for row, spent in timed:
        if row.metric == CONTROL:
            controls[row.case] = min(spent, controls.get(row.case, spent))
    for row, spent in timed:
        steady = row.metric != CONTROL and not row.metric.startswith(UNSTEADY) and not row.metric.endswith(RARE)
        if row.unit == "ms" and steady and not row.method.endswith("unrolled") and row.case in controls:
            found[row.case, row.method, row.metric] = spent / controls[row.case]
    return found
