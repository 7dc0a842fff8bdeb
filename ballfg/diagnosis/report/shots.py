"""Draws predictions: one shot before and after, and the errors by place, by time and along the recording."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ballfg.arrays import Array
from ballfg.diagnosis.report.pictures import AFTER, BEFORE, GREY
from ballfg.diagnosis.result import Errors, PredictedPath

ACROSS, DEEP = 6, 4  # Cells of the map along the longer and the shorter side of the table
LEAST_SAMPLES: Final = 5  # Least number of samples in a cell or bin for its error
SHEET: Final = 5.2  # Inches, width of a picture beside another one: wider ones shrink until they are unreadable
BINS: Final = 8  # Number of bins of time


@dataclass(frozen=True)
class ShotErrors:
    """One held-out track, predicted by the declared and by the corrected model, or twice by an unchanged one."""

    before: PredictedPath
    after: PredictedPath

    @property
    def errors(self) -> tuple[float, float]:
        """mm, root mean square distance before and after."""
        old, new = (1e3 * float(np.sqrt((distances(p) ** 2).mean())) for p in (self.before, self.after))
        return old, new


def distances(path: PredictedPath) -> Array:
    """(k,) m between predicted and measured positions."""
    return np.asarray(np.linalg.norm(path.predicted - path.measured, axis=-1))


def median_shot(before: Errors, after: Errors, changed: bool) -> ShotErrors | None:
    """The shot with the median gain, or the median error of an unchanged model; None without predictions."""
    later = {path.name: path for path in after.paths}
    shots = [ShotErrors(path, later[path.name]) for path in before.paths if path.name in later]
    if not shots:
        return None
    key = (lambda s: s.errors[0] - s.errors[1]) if changed else (lambda s: s.errors[1])
    return sorted(shots, key=key)[(len(shots) - 1) // 2]


def shot_picture(shot: ShotErrors, changed: bool) -> Figure:
    """Side view, top view and error over time of one shot."""
    figure = Figure(figsize=(SHEET, 7.2), layout="constrained")
    side, top, error = figure.subplots(3, 1)
    path = shot.after
    begin = path.seen[0] if len(path.seen) else path.measured[0]
    origin = begin * np.array([1.0, 1.0, 0.0])
    ahead = (path.measured[-1] - begin) * np.array([1.0, 1.0, 0.0])
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    left = np.array([-ahead[1], ahead[0], 0.0])
    models = [("predicted", path, AFTER)]
    if changed:
        models = [("predicted before", shot.before, BEFORE), ("predicted after", path, AFTER)]
    for axes, up, label in ((side, np.array([0.0, 0.0, 1.0]), "height"), (top, left, "to the left")):
        for points, marker, name in ((path.seen, "x", "measured, observed"), (path.measured, "o", "measured later")):
            place = (points - origin) @ np.stack((ahead, up), axis=-1)
            axes.plot(*place.T, marker, color=GREY, markersize=4, fillstyle="none", label=name)
        for name, predicted, colour in models:
            place = (predicted.predicted - origin) @ np.stack((ahead, up), axis=-1)
            axes.plot(*place.T, "-", color=colour, linewidth=1.6, label=name)
        axes.set(xlabel="distance along the shot, m", ylabel=f"{label}, m")
    side.set_title("from the side", size=11)
    top.set_title("from above", size=11)
    figure.legend(*side.get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize="small")
    for name, predicted, colour in models:
        error.plot(predicted.times, 1e3 * distances(predicted), ".-", color=colour, label=name)
    error.set(xlabel="time since the last observed sample, s", ylabel="error, mm", ylim=(0.0, None))
    error.set_title("distance of predicted from measured", size=11)
    for axes in (side, top, error):
        axes.grid(visible=True, alpha=0.25)
    return figure


def error_map(before: Errors, after: Errors, changed: bool) -> Figure:
    """Prediction errors by place, seen from above, by time since the last observed sample, and along the recording."""
    series = [("before", before, BEFORE), ("after", after, AFTER)] if changed else [("", after, AFTER)]
    figure = Figure(figsize=(SHEET, 4.6 + 2.6 * len(series)), layout="constrained")
    panels: Sequence[Axes] = figure.subplots(len(series) + 2, 1)
    places = np.concatenate([path.measured for path in after.paths])
    ends = np.quantile(places[:, :2], (0.01, 0.99), axis=0).T
    counts = (DEEP, ACROSS) if np.ptp(ends[1]) > np.ptp(ends[0]) else (ACROSS, DEEP)
    edges = [np.linspace(low - 1e-6, high + 1e-6, 1 + n) for (low, high), n in zip(ends, counts, strict=True)]
    cells = [_cells(errors.paths, edges) for _, errors, _ in series]
    top = max((float(np.nanmax(c)) for c in cells if np.isfinite(c).any()), default=1.0)
    for axes, (name, _, _), cell in zip(panels, series, cells, strict=False):
        extent = (edges[0][0], edges[0][-1], edges[1][0], edges[1][-1])
        axes.imshow(cell.T, origin="lower", extent=extent, aspect="auto", cmap="YlOrRd", vmin=0.0, vmax=top)
        middles = [0.5 * (e[1:] + e[:-1]) for e in edges]
        for i, j in np.argwhere(np.isfinite(cell)):
            ink = "white" if cell[i, j] > 0.65 * top else "black"
            axes.text(middles[0][i], middles[1][j], f"{cell[i, j]:.0f}", ha="center", va="center", size=9, color=ink)
        axes.set(xlabel="x, m", ylabel="y, m")
        axes.set_title(f"error by place, from above, mm{f': {name}' if name else ''}", size=11)
    ahead, along = panels[-2:]
    for name, errors, colour in series:
        ahead.plot(*_in_time(errors.paths), "o-", color=colour, label=name)
        by_track = [1e3 * np.sqrt((distances(path) ** 2).mean()) for path in errors.paths]
        along.plot(np.arange(1, 1 + len(by_track)), by_track, ".", color=colour)
    ahead.set(xlabel="time since the last observed sample, s", ylabel="error, mm", ylim=(0.0, None))
    ahead.set_title("prediction error by time", size=11)
    along.set(xlabel="held-out tracks in their order", ylabel="error, mm", ylim=(0.0, None))
    along.set_title("prediction error along the recording", size=11)
    along.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in (ahead, along):
        axes.grid(visible=True, alpha=0.25)
    if changed:
        ahead.legend(fontsize="small")
    return figure


def _cells(paths: Sequence[PredictedPath], edges: Sequence[Array]) -> Array:
    """(a, b) mm, root mean square error of the samples in each cell; NaN for few samples."""
    where = np.concatenate([path.measured[:, :2] for path in paths])
    squares = np.concatenate([distances(path) ** 2 for path in paths])
    places = [np.searchsorted(own, where[:, i], side="right") - 1 for i, own in enumerate(edges)]
    shape = tuple(len(own) - 1 for own in edges)
    inside = np.all([(place >= 0) & (place < size) for place, size in zip(places, shape, strict=True)], axis=0)
    cell = np.ravel_multi_index([place[inside] for place in places], shape)
    count, total = (np.bincount(cell, weights, np.prod(shape)).reshape(shape) for weights in (None, squares[inside]))
    return np.where(count >= LEAST_SAMPLES, 1e3 * np.sqrt(total / np.maximum(count, 1)), np.nan)


def _in_time(paths: Sequence[PredictedPath]) -> tuple[Array, Array]:
    """(b,) s and (b,) mm, root mean square error over bins of equal counts."""
    times = np.concatenate([path.times for path in paths])
    squares = np.concatenate([distances(path) ** 2 for path in paths])
    order = np.argsort(times, kind="stable")
    parts = [part for part in np.array_split(order, BINS) if len(part) >= LEAST_SAMPLES]
    return np.array([times[p].mean() for p in parts]), np.array([1e3 * np.sqrt(squares[p].mean()) for p in parts])
