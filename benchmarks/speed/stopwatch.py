"""Measures wall-clock times of warm, repeated runs, next to a control for the machine's present speed."""

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ballfg.benchmarks.metrics import Figure, median_and_quartiles
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.speed.banded import BandedProblem

CONTROL_SIZE = 512  # Size of the square float64 matrices whose product is the control


def milliseconds(action: Callable[[], object]) -> float:
    """Time of one call."""
    start = time.perf_counter()
    action()
    return 1e3 * (time.perf_counter() - start)


@dataclass(frozen=True)
class Stopwatch:
    """Times actions and adds their rows.

    Attributes:
        results: gets the rows.  case: of all of them.  runs: timed ones.  warm_up: runs before them, not counted.
        banded: the problem that the control solves.
    """

    results: Results
    case: str
    runs: int
    warm_up: int
    banded: BandedProblem

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
