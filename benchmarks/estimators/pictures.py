"""Draws the pictures of the comparison of estimators."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from ballfg.benchmarks.estimators.measured import HORIZON, OBSERVE, Measured, prediction_rmse
from ballfg.benchmarks.pictures import BLUE, GREY, ORANGE, curve, plain_ticks, save
from ballfg.benchmarks.results import Row
from ballfg.estimation.noise.forecasts import NINETY
from ballfg.estimation.track_prediction import TrackPrediction

STYLES: dict[str, tuple[str, float, Any]] = {
    "sliding-window": (GREY, 2.0, "solid"),
    "ekf": (ORANGE, 4.5, "solid"),
    "ekf-no-window": ("#e6ab02", 3.0, (0, (4, 2))),
    "ekf+rts": ("#e6ab02", 4.5, (0, (1, 1))),
    "online": ("#1b9e77", 3.0, (0, (4, 2))),
    "smoother": (BLUE, 1.3, "solid"),
}
"""Colour, width in points and dashes. Methods that agree lie on top of each other: the lower ones are wider."""
OTHER = ("black", 2.0, "solid")  # Style of a method that has none of its own
LEAST_SHOWN = 0.1  # Lower end of a band divided by its mean; a logarithmic axis has no place for zero
EXAMPLES = 3  # Tracks shown one by one


def _line(method: str) -> dict[str, Any]:
    colour, width, dashes = STYLES.get(method, OTHER)
    line = {"color": colour, "linestyle": dashes, "linewidth": width, "zorder": 10.0 - width}
    return line | {"label": method, "marker": "o", "markersize": 3}


def _band(method: str) -> dict[str, Any]:
    return {"color": STYLES.get(method, OTHER)[0], "alpha": 0.13, "linewidth": 0}


def observations_picture(rows: list[Row], case: str, title: str, path: Path) -> Path:
    """The paper's figure, velocity error against the number of observations; beside it, when all were seen."""
    figure, panels = plt.subplots(1, 2, figsize=(11.5, 4.6), sharey=True, layout="constrained")
    labels = {
        "newest": ("number of observations", "at the newest sample"),
        "whole": ("sample", "at each sample, once the whole track was seen"),
    }
    shown = {}
    for axes, (when, (place, what)) in zip(panels, labels.items(), strict=True):
        for method in dict.fromkeys(row.method for row in rows if row.case == case):
            counts, mean = curve(rows, case, method, f"velocity_mean_{when}")
            if not len(counts):
                continue
            _, deviation = curve(rows, case, method, f"velocity_sd_{when}")
            (shown[method],) = axes.plot(counts, mean, **_line(method))
            low = np.maximum(mean - deviation, LEAST_SHOWN * mean)
            axes.fill_between(counts, low, mean + deviation, **_band(method))
        axes.set(xlabel=place, yscale="log")
        axes.set_title(what, size=10)
        plain_ticks(axes.yaxis)
        axes.grid(visible=True, alpha=0.25)
    panels[0].set_ylabel("velocity error, m/s")
    figure.suptitle(f"{title}\nmean, and one standard deviation over tracks", size=11)
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=len(shown), fontsize="small")
    return save(figure, path)


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
        axes.fill_between(times, low, high, **_band(method))
    count = len(measured.predictions["smoother"])
    axes.set(
        xlabel=f"time after the {OBSERVE:g} s that were observed, s",
        ylabel="distance between predicted and measured position, mm",
        yscale="log",
        title=f"{measured.name}: error over the horizon, median and quartiles of {count} tracks",
    )
    plain_ticks(axes.yaxis)
    axes.grid(visible=True, alpha=0.25)
    axes.legend()
    return save(figure, path)


def calibration_picture(rows: list[Row], measured: Measured, path: Path) -> Path:
    """Share of measured coordinates inside the central intervals, against the share that should be."""
    figure, axes = plt.subplots(figsize=(5.2, 5.0), layout="constrained")
    axes.plot([0, 1], [0, 1], color="black", linewidth=0.8, label="perfect")
    for method in measured.predictions:
        axes.plot(*curve(rows, measured.name, method, "coverage"), **_line(method))
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
    observed, start = prediction.estimate, prediction.estimate.times[0]
    later = prediction.times - start
    for i, axes in enumerate(column):
        axes.plot(observed.times - start, observed.states[:, i], color=BLUE, label="estimated")
        middle, spread = prediction.positions[:, i], NINETY * prediction.sigmas[:, i]
        axes.plot(later, middle, color=ORANGE, label="predicted, 90 %")
        axes.fill_between(later, middle - spread, middle + spread, color=ORANGE, alpha=0.25, linewidth=0)
        axes.plot(later, prediction.measured[:, i], "k.", markersize=3, label="measured later")
        axes.axvline(observed.times[-1] - start, color="black", linewidth=0.5)
        axes.grid(visible=True, alpha=0.25)
    axes.set_xlabel("time, s")
