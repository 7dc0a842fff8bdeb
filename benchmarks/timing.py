"""Wall-clock times of warm, repeated runs, next to a control that shows how fast the machine is just now."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.benchmarks.metrics import Figure

Array = NDArray[np.float64]

CONTROL_SIZE = 512
"""Of the square float64 matrices whose product is the control."""


@dataclass(frozen=True)
class Stopwatch:
    """How times are taken.

    Attributes:
        runs: timed ones.
        warm_up: runs before them, not counted.
    """

    runs: int
    warm_up: int = 5

    def time(self, action: Callable[[], object]) -> Figure:
        """Median and quartiles of an action's time, ms."""
        for _ in range(self.warm_up):
            action()
        gc.collect()
        return quartiles(np.array([_once(action) for _ in range(self.runs)]))

    def control(self) -> Figure:
        """Time of one fixed matrix product, ms."""
        rng = np.random.default_rng(0)
        a, b = rng.standard_normal((2, CONTROL_SIZE, CONTROL_SIZE))
        return self.time(lambda: a @ b)


def _once(action: Callable[[], object]) -> float:
    start = time.perf_counter()
    action()
    return 1e3 * (time.perf_counter() - start)


def quartiles(times: Array) -> Figure:
    """Median with lower and upper quartile."""
    low, middle, high = np.quantile(times, [0.25, 0.5, 0.75])
    return Figure(float(middle), float(low), float(high))
