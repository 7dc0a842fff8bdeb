"""Pictures of the comparison, as PNG files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ballfg.benchmarks.estimators.measured import HORIZON, OBSERVE, Measured
from ballfg.benchmarks.results import CURVE_MARK, Row
from ballfg.files.whole_file import whole_file
from ballfg.prediction import TrackPrediction

matplotlib.use("Agg")

DPI = 130
COLOURS = {
    "sliding-window": "#7f7f7f",
    "ekf": "#d95f02",
    "ekf-no-window": "#e6ab02",
    "ekf+rts": "#e6ab02",
    "online": "#1b9e77",
    "smoother": "#3b4cc0",
}
WIDTHS = {"ekf": 4.5, "ekf-no-window": 3.0, "ekf+rts": 4.5, "online": 3.0, "smoother": 1.3}
"""Points. Methods that agree lie on top of each other: the lower ones are wider."""
DASHES = {"online": (0, (4, 2)), "ekf+rts": (0, (1, 1)), "ekf-no-window": (0, (4, 2))}
LEAST_SHOWN = 0.1
"""Lower end of a band divided by its mean; a logarithmic axis has no place for zero."""
EXAMPLES = 3
"""Tracks shown one by one."""
NINETY = 1.645
"""Standard deviations to each side of a normal distribution's central 90 %."""


def save(figure: Figure, path: Path) -> Path:
    """Write a PNG; the name appears once the file is whole."""
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")
    plt.close(figure)
    return path


def curve(rows: Iterable[Row], case: str, method: str, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Places and values of a curve, from the rows named `metric@place`."""
    prefix = metric + CURVE_MARK
    found = [
        (float(row.metric.removeprefix(prefix)), np.nan if row.value is None else row.value)
        for row in rows
        if row.case == case and row.method == method and row.metric.startswith(prefix)
    ]
    points = np.array(sorted(found)).reshape(-1, 2)
    return points[:, 0], points[:, 1]


def observations_picture(rows: list[Row], case: str, title: str, path: Path) -> Path:
    """The paper's figure, velocity error against the number of observations; beside it, when all were seen."""
    figure, panels = plt.subplots(1, 2, figsize=(11.5, 4.6), sharey=True, layout="constrained")
    labels = {
        "newest": ("number of observations", "at the newest sample"),
        "whole": ("sample", "at each sample, once the whole track was seen"),
    }
    for axes, (when, (place, what)) in zip(panels, labels.items(), strict=True):
        for method in dict.fromkeys(row.method for row in rows if row.case == case):
            counts, mean = curve(rows, case, method, f"velocity_mean_{when}")
            if not len(counts):
                continue
            _, deviation = curve(rows, case, method, f"velocity_sd_{when}")
            axes.plot(counts, mean, **_line(method))
            low = np.maximum(mean - deviation, LEAST_SHOWN * mean)
            axes.fill_between(counts, low, mean + deviation, color=COLOURS[method], alpha=0.13, linewidth=0)
        axes.set(xlabel=place, yscale="log", title=what)
        axes.title.set_size(10)
        _plain_ticks(axes)
    panels[0].set_ylabel("velocity error, m/s")
    figure.suptitle(f"{title}\nmean, and one standard deviation over tracks", size=11)
    handles, names = panels[0].get_legend_handles_labels()
    more, other = panels[1].get_legend_handles_labels()
    shown = dict(zip(names + other, handles + more, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=len(shown), fontsize="small")
    return save(figure, path)


def _plain_ticks(axes: Axes) -> None:
    """Numbers as 0.05, not as powers of ten, at 1, 2 and 5 of each decade of the vertical axis."""
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="major", alpha=0.25)


def _line(method: str) -> dict[str, Any]:
    return {
        "color": COLOURS.get(method, "black"),
        "linestyle": DASHES.get(method, "solid"),
        "label": method,
        "linewidth": WIDTHS.get(method, 2.0),
        "zorder": 10.0 - WIDTHS.get(method, 2.0),
        "marker": "o",
        "markersize": 3,
    }


def growth_picture(rows: list[Row], measured: Measured, path: Path) -> Path:
    """Prediction error against the time since the last observed sample."""
    figure, axes = plt.subplots(figsize=(7.5, 4.6), layout="constrained")
    for method in measured.predictions:
        times, median = curve(rows, measured.name, method, "prediction_error_median")
        if not len(times):
            continue
        _, low = curve(rows, measured.name, method, "prediction_error_lower_quartile")
        _, high = curve(rows, measured.name, method, "prediction_error_upper_quartile")
        axes.plot(times, median, **_line(method))
        axes.fill_between(times, low, high, color=COLOURS[method], alpha=0.13, linewidth=0)
    axes.set(
        xlabel=f"time after the {OBSERVE:g} s that were observed, s",
        ylabel="distance between predicted and measured position, mm",
        yscale="log",
        title=f"{measured.name}: error over the horizon, median and quartiles of {_count(measured)} tracks",
    )
    _plain_ticks(axes)
    axes.legend()
    return save(figure, path)


def calibration_picture(rows: list[Row], measured: Measured, path: Path) -> Path:
    """Share of measured coordinates inside the central intervals, against the share that should be."""
    figure, axes = plt.subplots(figsize=(5.2, 5.0), layout="constrained")
    axes.plot([0, 1], [0, 1], color="black", linewidth=0.8, label="perfect")
    for method in measured.predictions:
        nominal, share = curve(rows, measured.name, method, "coverage")
        axes.plot(nominal, share, **_line(method))
    axes.set(
        xlabel="nominal level of the interval",
        ylabel="share of measured coordinates inside",
        xlim=(0, 1),
        ylim=(0, 1),
        aspect="equal",
        title=f"{measured.name}: calibration of the predictions",
    )
    axes.grid(visible=True, alpha=0.25)
    axes.legend(loc="upper left")
    return save(figure, path)


def tracks_picture(measured: Measured, path: Path) -> Path:
    """Some tracks, from good to bad, with the smoother's predictions and their 90 % intervals."""
    from ballfg.benchmarks.estimators.measured import prediction_rmse

    ordered = sorted(measured.predictions["smoother"], key=prediction_rmse)
    shares = np.linspace(0.1, 0.9, EXAMPLES)
    chosen = [(share, ordered[round(share * (len(ordered) - 1))]) for share in shares]
    figure, axes = plt.subplots(3, EXAMPLES, figsize=(11, 7), sharex="col", layout="constrained", squeeze=False)
    for column, (share, prediction) in zip(axes.T, chosen, strict=True):
        _draw_track(column, prediction)
        error = 1e3 * prediction_rmse(prediction)
        column[0].set_title(f"{prediction.name}\nRMSE {error:.1f} mm, {100 * share:.0f} % of tracks are better", size=9)
    for row, axis in zip(axes, "xyz", strict=True):
        row[0].set_ylabel(f"{axis}, m")
    axes[0, 0].legend(fontsize="small")
    figure.suptitle(f"{measured.name}: predictions of the smoother after {OBSERVE:g} s, for {HORIZON:g} s", size=11)
    return save(figure, path)


def _draw_track(column: Iterable[Any], prediction: TrackPrediction) -> None:
    """One column: x, y, z against time."""
    observed, start = prediction.estimate, prediction.estimate.times[0]
    later = prediction.times - start
    for i, axes in enumerate(column):
        axes.plot(observed.times - start, observed.states[:, i], color=COLOURS["smoother"], label="estimated")
        middle, spread = prediction.positions[:, i], NINETY * prediction.sigmas[:, i]
        axes.plot(later, middle, color=COLOURS["ekf"], label="predicted, 90 %")
        axes.fill_between(later, middle - spread, middle + spread, color=COLOURS["ekf"], alpha=0.25, linewidth=0)
        axes.plot(later, prediction.measured[:, i], "k.", markersize=3, label="measured later")
        axes.axvline(observed.times[-1] - start, color="black", linewidth=0.5)
        axes.grid(visible=True, alpha=0.25)
    axes.set_xlabel("time, s")


def _count(measured: Measured) -> int:
    return len(measured.predictions["smoother"])
