"""Draws the dynamics comparison: errors by method, apex errors by flight, and a launch fanned out by its spin."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from ballfg.arrays import Array
from ballfg.benchmarks.dynamics.contenders import Record
from ballfg.benchmarks.dynamics.task import APEXES, Task
from ballfg.benchmarks.estimators.measured import HORIZON
from ballfg.benchmarks.pictures import BLUE, GREY, ORANGE, curve, save
from ballfg.benchmarks.results import Row
from ballfg.dynamics.surfaces import TABLE_LENGTH, TABLE_WIDTH
from ballfg.simulation.settings import SETTING_LEVELS

COLOURS: Final = {
    "truth": "#bdbdbd",
    "nominal": GREY,
    "nominal+track": "#525252",
    "lstm": "#e6ab02",
    "diffusion": ORANGE,
    "a-tune": "#a6761d",
    "mlp": "#7570b3",
    "mlp+gs": "#66a0d8",
    "skip+gs": "#1b9e77",
    "mnn+gs": BLUE,
    "analytic+mnn": "#08306b",
}
"""By method, the same with and without augmentation."""
TABLE_COLOUR: Final = "#2d6a4f"
FLIGHT_NAMES: Final = dict(zip(APEXES, ("before bounce 1", "between 1 and 2", "between 2 and 3"), strict=True))
FANNED: Final = ("mnn+gs", "skip+gs", "mlp+gs", "mlp", "a-tune", "nominal")
"""Whose paths are shown next to the true ones: the first of these that took part."""
MARGIN: Final = 0.1  # m, shown round the table
GROUP_WIDTH: Final = 0.8  # Width of a group of bars, for groups 1 apart


def _colour_of(method: str) -> str:
    return COLOURS.get(method.removesuffix("+aug"), "black")


def _of_metric(rows: Sequence[Row], case: str, metric: str) -> dict[str, Row]:
    return {r.method: r for r in rows if (r.case, r.metric) == (case, metric) and r.value is not None}


def rmse_picture(rows: Sequence[Row], task: Task, path: Path) -> Path:
    """Root mean square distance by method: over the track and after the observed part; dots are seeds.

    Pooled over simulated tracks; of measured ones, which may hold what no model can predict, the median track.
    """
    count = len(task.validation)
    if task.truth is None:
        against, which, ending = "measured", f"median of {count} tracks", "_median"
        spans = (f"until {HORIZON:g} s after the observed part", f"the {HORIZON:g} s after the observed part")
    else:
        against, which, ending = "true", f"{count} tracks", ""
        spans = ("whole track", "after the observed part")
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    for axes, metric, what in zip(panels, ("track_rmse", "rest_rmse"), spans, strict=True):
        found = _of_metric(rows, task.case, metric + ending)
        for place, row in enumerate(found.values()):
            _bar(axes, place, row, 1e3 * curve(rows, row.case, row.method, row.metric)[1])
        axes.set_xticks(range(len(found)), list(found), rotation=30, ha="right")
        axes.set(ylabel="RMSE, mm", title=what)
        axes.grid(visible=True, axis="y", alpha=0.25)
        axes.margins(y=0.12)
    note = "; whiskers: lowest and highest seed" if any(row.low is not None for row in rows) else ""
    figure.suptitle(f"{task.case}: distance between predicted and {against} positions, {which}{note}", size=11)
    return save(figure, path)


def _bar(axes: Axes, place: float, row: Row, seeds: Array) -> None:
    top = value = 1e3 * (row.value or 0.0)
    axes.bar(place, value, GROUP_WIDTH, color=_colour_of(row.method))
    if row.low is not None and row.high is not None:
        top = 1e3 * row.high
        axes.errorbar(place, value, [[value - 1e3 * row.low], [top - value]], color="black", capsize=3)
    axes.plot([place] * len(seeds), seeds, "k.", markersize=4)
    axes.annotate(f"{value:.1f}", (place, top), (0, 3), textcoords="offset points", ha="center", size=8)


def apex_picture(rows: Sequence[Row], task: Task, path: Path) -> Path:
    """Mean apex error by flight and method, with one standard deviation over tracks."""
    methods = list(dict.fromkeys(r.method for r in rows if r.case == task.case and r.metric.startswith("apex")))
    figure, axes = plt.subplots(figsize=(11, 4.6), layout="constrained")
    width, names = GROUP_WIDTH / len(methods), []
    for place, flight in enumerate(APEXES):
        means, spreads = (_of_metric(rows, task.case, f"apex_{flight}_{which}") for which in ("mean", "std"))
        for method in means.keys() & spreads.keys():
            x = place + (methods.index(method) - (len(methods) - 1) / 2) * width
            value, std = (1e3 * (found[method].value or 0.0) for found in (means, spreads))
            axes.bar(x, value, 0.9 * width, color=_colour_of(method))
            axes.errorbar(x, value, [[min(std, value)], [std]], color="black", linewidth=0.8, capsize=2)
            axes.annotate(f"{value:.0f}", (x, value + std), (0, 2), textcoords="offset points", ha="center", size=8)
        names.append(f"{FLIGHT_NAMES[flight]}\n{max((row.n for row in means.values()), default=0)} tracks")
    axes.set_xticks(range(len(APEXES)), names)
    axes.set(ylabel="apex error, mm", title=f"{task.case}: apex error, mean and one standard deviation over tracks")
    handles = [plt.Rectangle((0, 0), 1, 1, color=_colour_of(method)) for method in methods]
    axes.legend(handles, methods, loc="upper left", ncols=2, fontsize="small")
    axes.grid(visible=True, axis="y", alpha=0.25)
    return save(figure, path)


def fan_picture(records: Sequence[Record], table_height: float, path: Path) -> Path:
    """The paths of one launch for all levels of topspin, from the side, and of sidespin, from above."""
    fans = {record.method: record.fan for record in reversed(records) if record.fan is not None}
    learned = next((method for method in FANNED if method in fans), None)
    shown = [method for method in ("truth", learned) if method in fans]
    size = (5.4 * len(shown) + 0.8, 5.6)
    figure, panels = plt.subplots(
        2, len(shown), figsize=size, sharey="row", squeeze=False, layout="constrained", height_ratios=(1.0, 1.8)
    )
    for (side, above), method in zip(panels.T, shown, strict=True):
        side.plot([0, TABLE_LENGTH], [table_height] * 2, color=TABLE_COLOUR, linewidth=3)
        table = plt.Rectangle((0, -TABLE_WIDTH / 2), TABLE_LENGTH, TABLE_WIDTH, color=TABLE_COLOUR, alpha=0.15, lw=0)
        above.add_patch(table)
        side.set_title(method)
        above.set(xlabel="x, m", ylim=(-TABLE_WIDTH / 2 - MARGIN, TABLE_WIDTH / 2 + MARGIN))
    panels[0, 0].set_ylabel("from the side: z, m")
    panels[1, 0].set_ylabel("from above: y, m")
    for row, name, across in zip(panels, ("topspin", "sidespin"), (2, 1), strict=True):
        top = max(map(abs, SETTING_LEVELS[name]))
        colours = ScalarMappable(Normalize(-top, top), "coolwarm")
        figure.colorbar(colours, ax=row, label=f"{name} level", shrink=0.8)
        for axes, method in zip(row, shown, strict=True):
            for level, points in vars(fans[method])[name].items():
                whole = np.array(points)
                on_table = whole[np.maximum.accumulate(whole[:, 0]) <= TABLE_LENGTH]
                axes.plot(on_table[:, 0], on_table[:, across], color=colours.to_rgba(level), linewidth=1.4)
            axes.set(aspect="equal", xlim=(-MARGIN, TABLE_LENGTH + MARGIN))
            axes.grid(visible=True, alpha=0.25)
    figure.suptitle("One launch, predicted for each launcher setting of its spin", size=11)
    return save(figure, path)
