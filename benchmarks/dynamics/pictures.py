"""Pictures of the dynamics comparison: errors by method, apex errors by flight, and a launch fanned out by its spin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from ballfg.benchmarks.dynamics.record import Record
from ballfg.benchmarks.dynamics.task import APEXES, Task
from ballfg.benchmarks.estimators.measured import HORIZON
from ballfg.benchmarks.pictures import save
from ballfg.benchmarks.results import CURVE_MARK, Row
from ballfg.simulation import SETTING_LEVELS
from ballfg.simulation.launcher import TABLE_LENGTH, TABLE_WIDTH

Array = NDArray[np.float64]

COLOURS: Final = {
    "truth": "#bdbdbd",
    "nominal": "#7f7f7f",
    "nominal+track": "#525252",
    "lstm": "#e6ab02",
    "diffusion": "#d95f02",
    "a-tune": "#a6761d",
    "mlp": "#7570b3",
    "mlp+gs": "#66a0d8",
    "skip+gs": "#1b9e77",
    "mnn+gs": "#3b4cc0",
    "analytic+mnn": "#08306b",
}
OTHER: Final = "black"
"""Of a method that has no colour of its own."""
FLIGHT_NAMES: Final = dict(zip(APEXES, ("before bounce 1", "between 1 and 2", "between 2 and 3"), strict=True))
FANNED: Final = ("mnn+gs", "skip+gs", "mlp+gs", "mlp", "a-tune", "nominal")
"""Whose paths are shown next to the true ones: the first of these that took part."""
SPIN_COLOURS: Final = "coolwarm"
MARGIN: Final = 0.1
"""m, shown round the table."""
GROUP_WIDTH: Final = 0.8
"""Of a group of bars, where groups are 1 apart."""


def colour_of(method: str) -> str:
    """The same for a method with and without augmentation."""
    return COLOURS.get(method.removesuffix("+aug"), OTHER)


def rmse_picture(rows: Sequence[Row], task: Task, path: Path) -> Path:
    """Root mean square distance by method: over the track and after the observed part; dots are seeds.

    Pooled over simulated tracks; of measured ones, which may hold what no model can predict, the median track.
    """
    spans = ("whole track", "after the observed part")
    if task.truth is None:
        spans = (f"until {HORIZON:g} s after the observed part", f"the {HORIZON:g} s after the observed part")
    metrics = ["track_rmse", "rest_rmse"]
    if task.truth is None:
        metrics = [f"{metric}_median" for metric in metrics]
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    for axes, metric, what in zip(panels, metrics, spans, strict=True):
        found = _of_metric(rows, task.case, metric)
        for place, (method, row) in enumerate(found.items()):
            _bar(axes, place, GROUP_WIDTH, rows, row, colour_of(method))
        axes.set_xticks(range(len(found)), list(found), rotation=30, ha="right")
        axes.set(ylabel="RMSE, mm", title=what)
        axes.grid(visible=True, axis="y", alpha=0.25)
        axes.margins(y=0.12)
    against = "true" if task.truth is not None else "measured"
    which = f"{len(task.validation)} tracks" if task.truth is not None else f"median of {len(task.validation)} tracks"
    note = "; whiskers: lowest and highest seed" if any(row.low is not None for row in rows) else ""
    figure.suptitle(f"{task.case}: distance between predicted and {against} positions, {which}{note}", size=11)
    return save(figure, path)


def apex_picture(rows: Sequence[Row], task: Task, path: Path) -> Path:
    """Mean apex error by flight and method, with one standard deviation over tracks."""
    methods = list(dict.fromkeys(r.method for r in rows if r.case == task.case and r.metric.startswith("apex")))
    figure, axes = plt.subplots(figsize=(11, 4.6), layout="constrained")
    width = GROUP_WIDTH / len(methods)
    for i, method in enumerate(methods):
        for place, flight in enumerate(APEXES):
            mean = _of_metric(rows, task.case, f"apex_{flight}_mean").get(method)
            spread = _of_metric(rows, task.case, f"apex_{flight}_std").get(method)
            if mean is None or spread is None or mean.value is None or spread.value is None:
                continue
            x, value, std = place + (i - (len(methods) - 1) / 2) * width, 1e3 * mean.value, 1e3 * spread.value
            axes.bar(x, value, 0.9 * width, color=colour_of(method))
            axes.errorbar(x, value, [[min(std, value)], [std]], color="black", linewidth=0.8, capsize=2)
            axes.annotate(f"{value:.0f}", (x, value + std), (0, 2), textcoords="offset points", ha="center", size=8)
    counts = [max((r.n for r in _of_metric(rows, task.case, f"apex_{f}_mean").values()), default=0) for f in APEXES]
    names = [f"{FLIGHT_NAMES[flight]}\n{count} tracks" for flight, count in zip(APEXES, counts, strict=True)]
    axes.set_xticks(range(len(APEXES)), names)
    axes.set(ylabel="apex error, mm", title=f"{task.case}: apex error, mean and one standard deviation over tracks")
    handles = [plt.Rectangle((0, 0), 1, 1, color=colour_of(method)) for method in methods]
    axes.legend(handles, methods, loc="upper left", ncols=2, fontsize="small")
    axes.grid(visible=True, axis="y", alpha=0.25)
    return save(figure, path)


def fan_picture(records: Sequence[Record], table_height: float, path: Path) -> Path:
    """The paths of one launch for all levels of topspin, from the side, and of sidespin, from above."""
    fans = {record.method: record.fan for record in reversed(records) if record.fan is not None}
    learned = next((method for method in FANNED if method in fans), None)
    shown = [method for method in ("truth", learned) if method in fans]
    figure, panels = plt.subplots(
        2,
        len(shown),
        figsize=(5.4 * len(shown) + 0.8, 5.6),
        sharey="row",
        squeeze=False,
        layout="constrained",
        height_ratios=(1.0, 1.8),
    )
    for column, method in zip(panels.T, shown, strict=True):
        fan = fans[method]
        _draw_fan(column[0], fan.topspin, "topspin", 2)
        _draw_fan(column[1], fan.sidespin, "sidespin", 1)
        column[0].plot([0, TABLE_LENGTH], [table_height] * 2, color="#2d6a4f", linewidth=3)
        column[1].add_patch(
            plt.Rectangle((0, -TABLE_WIDTH / 2), TABLE_LENGTH, TABLE_WIDTH, color="#2d6a4f", alpha=0.15, linewidth=0)
        )
        column[0].set_title(method)
        column[1].set(xlabel="x, m", ylim=(-TABLE_WIDTH / 2 - MARGIN, TABLE_WIDTH / 2 + MARGIN))
        for axes in column:
            axes.set(aspect="equal", xlim=(-MARGIN, TABLE_LENGTH + MARGIN))
            axes.grid(visible=True, alpha=0.25)
    panels[0, 0].set_ylabel("from the side: z, m")
    panels[1, 0].set_ylabel("from above: y, m")
    for row, name in zip(panels, ("topspin", "sidespin"), strict=True):
        levels = SETTING_LEVELS[name]
        scale = ScalarMappable(Normalize(-max(map(abs, levels)), max(map(abs, levels))), SPIN_COLOURS)
        figure.colorbar(scale, ax=row, label=f"{name} level", shrink=0.8)
    figure.suptitle("One launch, predicted for each launcher setting of its spin", size=11)
    return save(figure, path)


def _draw_fan(axes: Axes, paths: dict[int, Array], name: str, across: int) -> None:
    """Paths coloured by level, as far as the table goes: x against the axis `across`."""
    top = max(map(abs, SETTING_LEVELS[name]))
    colours = plt.get_cmap(SPIN_COLOURS)
    for level, whole in paths.items():
        path = whole[np.maximum.accumulate(whole[:, 0]) <= TABLE_LENGTH]
        axes.plot(path[:, 0], path[:, across], color=colours((level + top) / (2 * top)), linewidth=1.4)


def _of_metric(rows: Sequence[Row], case: str, metric: str) -> dict[str, Row]:
    """The rows of a metric by method, those that have a value."""
    return {r.method: r for r in rows if (r.case, r.metric) == (case, metric) and r.value is not None}


def _bar(axes: Axes, place: float, width: float, rows: Sequence[Row], row: Row, colour: str) -> None:
    """One bar in mm with its interval, its seeds as dots and its value above."""
    value = 1e3 * (row.value or 0.0)
    axes.bar(place, value, width, color=colour)
    top = value
    if row.low is not None and row.high is not None:
        axes.errorbar(place, value, [[value - 1e3 * row.low], [1e3 * row.high - value]], color="black", capsize=3)
        top = 1e3 * row.high
    prefix = row.metric + CURVE_MARK
    seeds = [1e3 * r.value for r in rows if _is_seed(r, row, prefix) and r.value is not None]
    axes.plot([place] * len(seeds), seeds, "k.", markersize=4)
    axes.annotate(f"{value:.1f}", (place, top), (0, 3), textcoords="offset points", ha="center", size=8)


def _is_seed(row: Row, mean: Row, prefix: str) -> bool:
    return (row.case, row.method) == (mean.case, mean.method) and row.metric.startswith(prefix)
