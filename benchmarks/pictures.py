"""Provides helpers for the pictures of all benchmarks."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ballfg.benchmarks.results import CURVE_MARK, Row
from ballfg.files.whole_file import whole_file

matplotlib.use("Agg")

DPI = 130
BLUE, ORANGE, GREY = "#3b4cc0", "#d95f02", "#7f7f7f"


def save(figure: Figure, path: Path) -> Path:
    """Write a PNG whole or not at all."""
    with whole_file(path) as part:
        figure.savefig(part, dpi=DPI, format="png")
    plt.close(figure)
    return path


def plain_ticks(axis: Axis, marked: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Numbers as 0.05, not as powers of ten, at some multiples of each decade of a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=marked))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def curve(rows: Iterable[Row], case: str, method: str, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Places and values of a curve, from the rows named `metric@place`."""
    prefix = metric + CURVE_MARK
    found = [
        (float(row.metric.removeprefix(prefix)), np.nan if row.value is None else row.value)
        for row in rows
        if (row.case, row.method) == (case, method) and row.metric.startswith(prefix)
    ]
    points = np.array(sorted(found)).reshape(-1, 2)
    return points[:, 0], points[:, 1]
