"""Draws a calibration: each track's coefficients, the population, a learned correction, the errors before and after."""

from pathlib import Path
from typing import Final, cast

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from ballfg.arrays import Array
from ballfg.checks import drawn
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.bounce import RestitutionSpeed
from ballfg.dynamics.effects.generic import FUNCTIONS, AirCorrection
from ballfg.estimation.noise.forecasts import NINETY
from ballfg.files.whole_file import whole_file
from ballfg.learning.calibration.correction import RESTITUTION, SLOPE, learned, spans
from ballfg.learning.calibration.problem import Problem, Step, population_model
from ballfg.learning.calibration.report import Comparison

matplotlib.use("Agg")

DPI = 130
TRACKS, BAND, START = "#3b4cc0", "#d95f02", "#7f7f7f"
AXES: Final = {"speed": "speed, m/s", "ratio": "spin ratio"}  # Quantities of a correction: their labels
CURVE: Final = 101  # Points of a curve


def draw(problem: Problem, last: Step, comparison: Comparison, path: Path) -> None:
    """Write the picture as a PNG file."""
    listed = problem.chosen.listed
    curves = [] if problem.correction is None else _curves(population_model(problem, last))
    bounces = problem.correction is not None and {SLOPE, RESTITUTION} <= set(problem.chosen.names)
    panels = len(listed) + len(curves) + bounces + 1
    columns = min(panels, 4)
    rows = -(-panels // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(4.0 * columns, 3.9 * rows), layout="constrained", squeeze=False)
    axes = list(grid.flat)
    for place, (k, _) in enumerate(listed):
        _coefficient(axes[place], problem, last, k)
    for place, curve in enumerate(curves, start=len(listed)):
        _correction(axes[place], *curve)
    if bounces:
        _restitution(axes[panels - 2], problem, last)
    _errors(axes[panels - 1], comparison)
    for unused in axes[panels:]:
        unused.set_axis_off()
    title = f"{drawn(problem.dataset.info.name)}: {len(last.fits)} tracks fitted, {len(comparison.pairs)} judge"
    figure.suptitle(title, size=11)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")
    plt.close(figure)


def _coefficient(axes: Axes, problem: Problem, last: Step, k: int) -> None:
    """Each track's estimate with its standard deviation, the population, its mean, and the starting value."""
    tracks = sorted((fit.values[k], fit.sigmas[k]) for fit in last.fits)
    values, sigmas = np.array(tracks).reshape(-1, 2).T
    order = np.arange(len(values))
    axes.errorbar(order, values, sigmas, fmt=".", color=TRACKS, elinewidth=0.7, label="tracks, 1 sigma")
    mean, width = last.mean[k], last.next_track[k]
    axes.axhspan(mean - width, mean + width, color=BAND, alpha=0.2, linewidth=0, label="a new track, 1 sigma")
    axes.axhline(mean, color=BAND, linewidth=1.5, label="mean")
    axes.axhline(float(problem.chosen.start[k]), color=START, linestyle="--", linewidth=1.0, label="before")
    unit = "" if problem.chosen.units[k] == "1" else f", {problem.chosen.units[k]}"
    axes.set(xlabel="tracks, sorted", ylabel=f"{problem.chosen.names[k]}{unit}")
    axes.set_title(f"{mean:.4g} ± {last.sigma[k]:.2g}, spread {last.spread[k]:.2g}", size=10)
    axes.grid(visible=True, alpha=0.25)
    axes.legend(fontsize="x-small")


def _curves(model: AnalyticModel) -> list[tuple[AnalyticModel, str, str]]:
    """Each force with a learned correction, along each of its two quantities."""
    values = cast(Effect, model.flight[AirCorrection.name]).values()
    forces = [force for force in ("drag", "lift") if any(values[f"{force}_{term}"] for term in FUNCTIONS)]
    return [(model, force, along) for force in forces for along in AXES]


def _correction(axes: Axes, model: AnalyticModel, force: str, along: str) -> None:
    """A learned correction in percent along one quantity, the other in the middle of its samples."""
    reach = spans(model)
    middle = {name: np.full(CURVE, 0.5 * (low + high)) for name, (low, high) in reach.items()}
    low, high = reach[along]
    at = middle | {along: np.linspace(max(low - 0.3 * (high - low), 0.0), high + 0.3 * (high - low), CURVE)}
    mean, sigma = (100.0 * values for values in learned(model, force, at["speed"], at["ratio"]))
    axes.axvspan(low, high, color=START, alpha=0.12, linewidth=0, label="90 % of the samples")
    _band(axes, at[along], mean, sigma)
    axes.axhline(0.0, color=START, linestyle="--", linewidth=1.0, label="declared law")
    (other,) = set(AXES) - {along}
    words, _, unit = AXES[other].partition(", ")
    axes.set_title(f"{force} where the {words} is {middle[other][0]:.3g} {unit}".rstrip(), size=10)
    axes.set(xlabel=AXES[along], ylabel=f"correction of {force}, %")
    axes.grid(visible=True, alpha=0.25)
    axes.legend(fontsize="x-small")


def _band(axes: Axes, along: Array, mean: Array, sigma: Array) -> None:
    """A learned curve with its 90 % band."""
    axes.fill_between(along, mean - NINETY * sigma, mean + NINETY * sigma, color=BAND, alpha=0.25, linewidth=0)
    axes.plot(along, mean, color=BAND, linewidth=1.5, label="learned, with its 90 % band")


def _restitution(axes: Axes, problem: Problem, last: Step) -> None:
    """The learned restitution against the normal speed of an impact, with errors of value and slope."""
    middle = cast(Effect, problem.model.bounce[RestitutionSpeed.name]).values()["reference"]
    speed = np.linspace(0.5 * middle, 1.5 * middle, CURVE)
    (e, e_sigma), (slope, slope_sigma) = (
        (last.mean[k], last.sigma[k]) for k in map(problem.chosen.names.index, (RESTITUTION, SLOPE))
    )
    mean, sigma = e - slope * (speed - middle), np.hypot(e_sigma, slope_sigma * (speed - middle))
    axes.axvline(middle, color=START, alpha=0.5, linewidth=1.0, label="median impact")
    _band(axes, speed, mean, sigma)
    axes.set(xlabel="normal speed of the impact, m/s", ylabel="restitution")
    axes.set_title("restitution against speed", size=10)
    axes.grid(visible=True, alpha=0.25)
    axes.legend(fontsize="x-small")


def _errors(axes: Axes, comparison: Comparison) -> None:
    """RMSE of each judging track, after against before."""
    pairs = 1e3 * comparison.pairs
    axes.set(xlabel="RMSE before, mm", ylabel="RMSE after, mm")
    axes.set_title(f"prediction better on {comparison.better} of {len(pairs)} tracks", size=10)
    axes.grid(visible=True, which="major", alpha=0.25)
    if not len(pairs):
        return
    ends = np.array([0.0, 1.05 * pairs.max()])
    axes.plot(ends, ends, color="black", linewidth=0.8, label="no change")
    axes.plot(pairs[:, 0], pairs[:, 1], ".", color=TRACKS, label="tracks")
    axes.plot(*np.median(pairs, axis=0), "D", color=BAND, label="medians")
    axes.set(xlim=ends, ylim=ends)
    axes.legend(fontsize="x-small")
