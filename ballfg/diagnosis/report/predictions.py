"""Reports the predictions before and after: errors on held-out tracks, one shot, and a map of the errors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ballfg.arrays import Array
from ballfg.diagnosis.budget import EXPECTED, PARTS
from ballfg.diagnosis.report import pictures
from ballfg.diagnosis.report.headline import of_population, skewed_medians
from ballfg.diagnosis.report.pictures import AFTER, BEFORE, GREY
from ballfg.diagnosis.report.wording import NONE, change, fixed, term
from ballfg.diagnosis.result import Diagnosis, Errors, PredictedPath
from ballfg.pages.html import Html, bar, items, picture, section, table, tag, text

BY_CHANCE: Final = 2.0  # Standard errors within which a NIS counts as 1
NEAR_FLOOR: Final = 1.2  # Ratio to the floor below which a model can hardly be improved


def errors(diagnosis: Diagnosis) -> Html:
    """Errors of predictions on the held-out half, before and after, with their ideal values."""
    before, after, changed = diagnosis.before, diagnosis.after, diagnosis.after is not diagnosis.before
    changed = changed and (bool(diagnosis.findings) or diagnosis.unexplained.fallback is not None)
    near = f"near {diagnosis.floor_mm:.1f} mm" if math.isfinite(diagnosis.floor_mm) else "small"
    held = (100 * before.intervals_held, 100 * after.intervals_held)
    numbers = (
        (term("prediction error"), before.prediction_rmse_mm, after.prediction_rmse_mm, " mm", near),
        (term("apex", "error of the apex"), before.apex_rmse_mm, after.apex_rmse_mm, " mm", "small"),
        (term("NIS"), before.nis, after.nis, "", "1"),
        (term("90 % intervals", "90 % intervals hold"), *held, " %", "90 %"),
        (term("log likelihood"), before.log_likelihood, after.log_likelihood, "", "large"),
    )
    said = " the first 40 % was observed. The rest was predicted and compared with the measured positions. "
    said += "Both models were" if changed else "The model was"
    said += " fitted to the other tracks" + (", the declared one without what was added." if changed else ".")
    words = tag("p", f"Of {diagnosis.tracks_judged_on} ", term("held-out tracks"), said)
    words = tag("p", diagnosis.evaluation) if diagnosis.evaluation else words
    if not changed:
        rows = [(name, _fixed(now, unit), goal) for name, _, now, unit, goal in numbers]
        shown = table(("", "value", "should be"), rows)
        return section("How well the model predicts", words, shown, items(meaning(diagnosis)))
    head = ("", "declared model (before)", "corrected model (after)", "change", "should be")
    lines = [
        (name, _fixed(was, unit), _fixed(now, unit), _changed(was, now, unit), goal)
        for name, was, now, unit, goal in numbers
    ]
    caption = "Each line is one of these tracks; diamonds pool them all."
    paired = picture(pictures.errors_by_track(before, after), caption)
    shown = tag("div", tag("div", table(head, lines)), paired, kind="beside")
    return section("How much predictions gain", words, shown, items(meaning(diagnosis)))


def meaning(diagnosis: Diagnosis) -> list[Html]:
    """The meaning of the table: the distance of the errors from the floor, and whether their stated size is right."""
    after, floor = diagnosis.after, diagnosis.floor_mm
    error, said = after.prediction_rmse_mm, list[Html]()
    if math.isfinite(floor + error):
        how = (
            "so that a better model would gain little"
            if error <= NEAR_FLOOR * floor
            else f"so that predictions are {error / floor:.1f} times as far off as they could be"
        )
        least = (
            f" is about {floor:.1f} mm: so much the noise of the measurements and what the observed part leaves open "
            f"of the release cost even an exact model. The error is {error:.1f} mm, {how}."
        )
        said.append(tag("span", "The ", term("floor"), least))
    if told := of_population(diagnosis):
        said.append(text(told))
    if medians := skewed_medians(diagnosis.before, after):
        was = f"{medians[0]:.1f} mm before and " if after is not diagnosis.before else ""
        off = f"{was}{medians[1]:.1f} mm{' after' if was else ''}"
        said.append(text(f"A few tracks make most of the prediction error: the median track is off by {off}."))
    if math.isfinite(after.nis) and after.nis > 0.0:
        said.append(text(_about_nis(after)))
    return said


def _about_nis(errors: Errors) -> str:
    """The meaning of a NIS for the stated uncertainty, and its deviation."""
    error = f" ± {fixed(errors.nis_error, 2)}" if math.isfinite(errors.nis_error) else ""
    begin, held = f"A NIS of {fixed(errors.nis, 2)}{error}", ""
    if math.isfinite(errors.intervals_held):
        held = f" 90 % intervals hold {100 * errors.intervals_held:.1f} % of the measured coordinates."
    if math.isfinite(errors.nis_error) and abs(errors.nis - 1.0) <= BY_CHANCE * errors.nis_error:
        return f"{begin} differs from 1 by no more than chance: predictions state their uncertainty rightly.{held}"
    share = 100 * abs(1.0 / math.sqrt(errors.nis) - 1.0)
    below = errors.nis < 1.0
    side, claim, size, ratio = (
        ("below", "better", "large", "larger") if below else ("above", "worse", "small", "smaller")
    )
    return (
        f"{begin} is {side} 1: predictions are {claim} than they claim. The noise behind them is stated too {size}; "
        f"their standard deviations are {share:.0f} % {ratio} than the errors.{held}"
    )


def _fixed(value: float, unit: str) -> str:
    return f"{fixed(value, 1 if unit else 2)}{unit}" if math.isfinite(value) else NONE


def _changed(was: float, now: float, unit: str) -> str:
    """The change of a length in percent; empty for numbers without a meaningful ratio."""
    if not math.isfinite(was + now):
        return "nothing to compare"
    return change(was, now) if unit == " mm" else ""


def parts_of_error(diagnosis: Diagnosis) -> Html:
    """The parts of the prediction error, as a table and bars; empty without a budget."""
    budget = diagnosis.budget
    if budget is None:
        return Html()
    whole = max(budget.total**2, sum(budget.squares[name] for name in EXPECTED))
    rows: list[tuple[str, str, str]] = []
    for name, words in PARTS.items():
        share = budget.squares[name] / whole
        length = bar(min(max(share, 0.0), 1.0), "added" if name in EXPECTED else "alike")
        rows.append((words, fixed(getattr(budget, name), 2), tag("span", length, f"{100 * share:.0f} %")))
    rows += [
        ("sum: the declared model's error", fixed(budget.total, 2), ""),
        ("sum without the last two parts: the floor of this model", fixed(budget.floor, 2), ""),
    ]
    words = (
        "The squares of the parts add up to the square of the measured error. A negative part takes away: the named "
        "effects made predictions worse, or errors are smaller than the model with its noise expects."
    )
    head = (term("error budget", "part"), "mm", "share of the square")
    return section("What the error consists of", tag("p", budget.sentence), table(head, rows), tag("p", words))


def one_shot(diagnosis: Diagnosis) -> Html:
    """One shot, and a map of the errors."""
    before, after = diagnosis.before, diagnosis.after
    changed = after is not before and bool(diagnosis.findings or diagnosis.unexplained.fallback)
    shot = median_shot(before, after, changed)
    if shot is None:
        return Html()
    was, now = shot.errors
    off = f"off by {was:.1f} mm before and {now:.1f} mm after" if changed else f"off by {now:.1f} mm"
    ranked = "gain is the median" if changed else "error is the median"
    of_all = f"{ranked} of all {len(after.paths)} held-out tracks"
    caption = f"Track {shot.after.name}, whose {of_all}: its prediction is {off}."
    words = "Root mean square errors of all held-out tracks. Cells without a number hold too few samples."
    drawn = picture(shot_picture(shot, changed), caption)
    mapped = picture(error_map(before, after, changed), words)
    return section("One shot, and where the errors are", tag("div", drawn, mapped, kind="beside"))


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
