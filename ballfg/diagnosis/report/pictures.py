"""Draws a diagnosis: residuals in flight, at contacts and in the measurements; errors; the rounds.

Each function draws one figure without pyplot. If a model was changed, `before` and `after` stand side by side or in one
panel, always with the same axes.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.diagnosis.report.binned import at_contact, binned, in_flight, slip_speed
from ballfg.diagnosis.result import Candidate, Errors, Outcome, Residuals
from ballfg.state import SPIN, VELOCITY, VZ

Series = Mapping[str, Residuals]  # Residuals by their name in the legend: `before` and `after`, or a single one
Parts = tuple[Mapping[str, Array], Array, Array, Index]
"""Conditions by name, components of a residual, their standard deviations, and numbers of stretches."""

BEFORE, AFTER, GREY = "#d55e00", "#0072b2", "#8c8c8c"
"""Okabe and Ito's vermilion and blue, distinct for every kind of colour vision."""
AXIS_COLOURS = ("#0072b2", "#e69f00", "#009e73")
IN_FLIGHT = ("along the flight", "across, to the left", "across, upwards")
AT_CONTACT = ("along the ground", "to the left", "up")
LARGEST_WHITENED = 4.0  # Limit of whitened residuals in means, so that one outlier hides no pattern of the others
HISTOGRAM_END = 6.0  # Whitened residuals at which the axis of their histogram ends
SHOWN_SHARE = 0.98  # Share of the single points inside the axes
LEAST_EXPLAINED = 0.3  # Least squared residual in the drawing: chance alone explains about 1
MARGINS = (0.8, 0.12, 0.52, 0.32)
"""Inches left and right of a grid of panels and below it, for names and numbers; above it, for a line of a title."""
NAMED = 6  # Number of named candidates of the first round in the picture of the rounds, beside those added later
LINES_OF_TEXT = 18  # Number of lines of text beside the picture of the rounds
MARKED = {Outcome.ADDED: ("added", AFTER), Outcome.ALIKE: ("alike", BEFORE)}
"""Word and colour of the prominent candidates there."""


def flight_in_time(series: Series) -> Figure:
    """Unmodelled acceleration against the time since launch, one column for each of the series."""
    figure, panels = _grid(3, len(series), (max(7.4, 5.0 * len(series)), 6.0), titles=2)
    for column, (label, residuals) in zip(panels.T, series.items(), strict=True):
        flight = residuals.flight
        _means(column, flight.times, *in_flight(flight), flight.stretch, label)
        column[0].set_title(label, size=11)
        column[-1].set_xlabel("time since launch or hit, s")
    title = "Acceleration that the model lacks: mean over stretches ± standard error"
    return _titled(figure, panels, IN_FLIGHT, "m/s²", title)


def flight_against(series: Series) -> Figure:
    """Unmodelled acceleration against speed, height and spin."""

    def parts(residuals: Residuals) -> Parts:
        flight, states = residuals.flight, residuals.flight.states
        conditions = {
            "speed, m/s": np.linalg.norm(states[:, VELOCITY], axis=-1),
            "height, m": states[:, 2],
            "spin, rad/s": np.linalg.norm(states[:, SPIN], axis=-1),
        }
        return conditions, *in_flight(flight), flight.stretch

    figure, panels = _against(series, parts, (10.5, 6.2))
    title = "Acceleration that the model lacks, against the state: mean ± standard error"
    return _titled(figure, panels, IN_FLIGHT, "m/s²", title)


def contacts(series: Series, radius: float) -> Figure:
    """Outgoing minus predicted velocity at contacts against the normal speed and the slip; radius: m, of the ball."""
    count = len(series)
    figure, panels = _grid(3, 2 * count, (max(8.2, 5.9 * count), 6.2), titles=2)
    points = []
    for i, (label, residuals) in enumerate(series.items()):
        contact = residuals.contact
        values, sigmas = at_contact(contact)
        points.append(values)
        slip = slip_speed(contact.incoming, radius)
        impacts = {"incoming normal speed, m/s": -contact.incoming[:, VZ], "incoming slip, m/s": slip}
        for j, (name, against) in enumerate(impacts.items()):
            column = panels[:, j * count + i]
            for axes, component in zip(column, values.T, strict=True):
                axes.plot(against, component, ".", color=GREY, markersize=3, alpha=0.45, zorder=1)
            _means(column, against, values, sigmas, contact.stretch, label)
            column[0].set_title(label, size=11)
            column[-1].set_xlabel(name)
            if i:
                column[0].sharex(panels[0, j * count])
    reach = 1.15 * float(np.quantile(np.abs(np.concatenate(points)), SHOWN_SHARE))
    if reach > 0.0:
        panels[0, 0].set_ylim(-reach, reach)
    title = "Kick to the velocity at a contact that the model lacks: each contact, mean ± standard error"
    return _titled(figure, panels, AT_CONTACT, "m/s", title)


def measurements(series: Series) -> Figure:
    """Whitened position residuals against time, place and speed."""

    def parts(residuals: Residuals) -> Parts:
        measured = residuals.measurement
        values = np.clip(measured.position / measured.sigma, -LARGEST_WHITENED, LARGEST_WHITENED)
        conditions = {
            "time since launch or hit, s": measured.times,
            **{f"{name}, m": measured.states[:, i] for i, name in enumerate("xyz")},
            "speed, m/s": np.linalg.norm(measured.states[:, VELOCITY], axis=-1),
        }
        return conditions, values, np.ones_like(values), measured.stretch

    figure, panels = _against(series, parts, (13.0, 6.0))
    title = "Measured minus fitted position over its noise: mean ± standard error"
    return _titled(figure, panels, tuple(f"residual {a}" for a in "xyz"), "sigma", title)


def histogram(series: Series) -> Figure:
    """Whitened position residuals of each axis before the normal distribution, on a logarithmic scale."""
    figure, panels = _grid(1, len(series), (max(7.4, 5.0 * len(series)), 3.2))
    edges = np.linspace(-HISTOGRAM_END, HISTOGRAM_END, 49)
    middle = 0.5 * (edges[1:] + edges[:-1])
    for axes, (label, residuals) in zip(panels[0], series.items(), strict=True):
        measured = residuals.measurement
        whitened = measured.position / measured.sigma
        for i, (name, colour) in enumerate(zip("xyz", AXIS_COLOURS, strict=True)):
            share = np.histogram(whitened[:, i], edges)[0] / max(len(whitened), 1) / (edges[1] - edges[0])
            axes.step(middle, np.where(share > 0.0, share, np.nan), where="mid", color=colour, label=name)
        axes.plot(middle, np.exp(-0.5 * middle**2) / np.sqrt(2.0 * np.pi), "k--", linewidth=1.0, label="normal")
        axes.set(yscale="log", ylim=(2e-4, 1.0), xlabel="(measured − fitted) / noise", title=label)
        axes.legend(fontsize="small")
    panels[0, 0].set_ylabel("density")
    return figure


def beyond_histogram(series: Series) -> str:
    """Number of residuals outside of the histogram, in a sentence: `Of 1200 before, 3 lie beyond ...`."""
    parts = []
    for label, residuals in series.items():
        whitened = residuals.measurement.position / residuals.measurement.sigma
        beyond = int((np.abs(whitened) > HISTOGRAM_END).sum())
        named = f" {label}" if len(series) > 1 else ""
        parts.append(f"{beyond} of {whitened.size} residuals{named}")
    return f"The axis ends at ±{HISTOGRAM_END:g}: {' and '.join(parts)} lie beyond it and are not shown."


def errors_by_track(before: Errors, after: Errors) -> Figure:
    """Prediction error of each held-out track before and after, joined by a line; the diamonds pool all tracks."""
    figure, panels = _grid(1, 1, (4.6, 4.2))
    axes = panels[0, 0]
    pairs = np.stack((before.by_track, after.by_track), axis=-1)
    pairs = pairs[np.isfinite(pairs).all(axis=-1)]
    fell = int((pairs[:, 1] < pairs[:, 0]).sum())
    for pair in pairs:
        colour = AFTER if pair[1] < pair[0] else BEFORE
        axes.plot((0, 1), pair, "o-", color=colour, alpha=0.4, markersize=4, linewidth=0.9)
    pooled = (before.prediction_rmse_mm, after.prediction_rmse_mm)
    axes.plot((0, 1), pooled, "D-", color="black", markersize=8, linewidth=2.2, label="all tracks")
    for x, value, side in ((0, pooled[0], "right"), (1, pooled[1], "left")):
        axes.annotate(f"{value:.1f}", (x, value), (-14 + 28 * x, 0), textcoords="offset points", ha=side, va="center")
    axes.set(xlim=(-0.35, 1.35), xticks=(0, 1), yscale="log", ylabel="prediction error, mm")
    axes.set_xticklabels(("before", "after"))
    axes.set_title(f"smaller on {fell} of {len(pairs)} tracks", size=11)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    return figure


def ranking(rounds: Sequence[Sequence[Candidate]]) -> Figure:
    """The squared residual explained by each candidate, round after round."""
    figure, panels = _grid(1, 1, (7.6, 4.2))
    axes = panels[0, 0]
    outcome = {c.name: c.outcome for row in reversed(rounds) for c in row}
    outcome |= {c.name: c.outcome for row in rounds for c in row if c.outcome is Outcome.ADDED}
    lines: dict[str, list[tuple[int, float]]] = {}
    for i, row in enumerate(rounds):
        for c in row:
            if c.outcome is not Outcome.INVISIBLE:
                lines.setdefault(c.name, []).append((i + 1, max(c.explained, LEAST_EXPLAINED)))
    for name, line in lines.items():
        _, colour = MARKED.get(outcome[name], ("", GREY))
        front = 2 + (outcome[name] in MARKED) + (outcome[name] is Outcome.ADDED)
        axes.plot(*zip(*line, strict=True), "o-", color=colour, markersize=5, linewidth=1.2, zorder=front)
    first = [c.name for c in rounds[0] if c.name in lines]
    named = first[:NAMED] + [name for name in first[NAMED:] if outcome[name] is Outcome.ADDED]
    for name, height in _apart({name: lines[name][0][1] for name in named}).items():
        word, colour = MARKED.get(outcome[name], ("", "black"))
        axes.plot((0.95, 1.0), (height, lines[name][0][1]), color=GREY, linewidth=0.6, zorder=1)
        axes.text(0.93, height, f"{name}, {word}" if word else name, ha="right", va="center", size=9, color=colour)
    axes.set(yscale="log", xlim=(0.2, len(rounds) + 0.3), xlabel="round", ylabel="squared whitened residual explained")
    axes.margins(y=0.12)
    axes.set_xticks(range(1, len(rounds) + 1))
    return figure


def _apart(places: Mapping[str, float]) -> dict[str, float]:
    """Heights of labels on a logarithmic axis: in order, and a line of text apart."""
    if not places:
        return {}
    line = max(1.0, np.log(max(places.values()) / LEAST_EXPLAINED)) / LINES_OF_TEXT
    placed: dict[str, float] = {}
    last = -np.inf
    for name, value in sorted(places.items(), key=lambda item: item[1]):
        last = max(float(np.log(value)), last + line)
        placed[name] = float(np.exp(last))
    return placed


def _grid(rows: int, columns: int, size: tuple[float, float], titles: int = 1) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of panels: those in a column share the horizontal axis, all share the vertical one.

    Args: size: inches.  titles: lines above the panels.
    """
    (left, right, bottom, line), (width, height) = MARGINS, size
    top = titles * line
    places = {"left": left / width, "right": 1 - right / width, "bottom": bottom / height, "top": 1 - top / height}
    figure = Figure(figsize=size)  # matplotlib's own layout takes longer than all the drawing
    panels = figure.subplots(
        rows, columns, squeeze=False, sharex="col", sharey=True, gridspec_kw=places | {"wspace": 0.05, "hspace": 0.1}
    )
    for axes in panels.flat:
        axes.grid(visible=True, which="major", alpha=0.25)
    return figure, panels


def _against(
    series: Series, parts: Callable[[Residuals], Parts], size: tuple[float, float]
) -> tuple[Figure, NDArray[np.object_]]:
    """A figure with three components of a residual, one a row, against conditions, one a column."""
    made = {label: parts(residuals) for label, residuals in series.items()}
    names = list(next(iter(made.values()))[0])
    figure, panels = _grid(3, len(names), size)
    for label, (conditions, values, sigmas, stretch) in made.items():
        for column, name in zip(panels.T, names, strict=True):
            _means(column, conditions[name], values, sigmas, stretch, label)
            column[-1].set_xlabel(name)
    if len(series) > 1:
        panels[0, 0].legend(fontsize="small")
    return figure, panels


def _means(column: Iterable[Axes], against: Array, values: Array, sigmas: Array, stretch: Index, label: str) -> None:
    """Three components of a residual, one in each panel of a column, as means over bins."""
    colour = BEFORE if label == "before" else AFTER
    for axes, component, sigma in zip(column, values.T, sigmas.T, strict=True):
        bins = binned(against, component, sigma, stretch)
        axes.axhline(0.0, color="black", linewidth=0.8, zorder=0)
        means = (bins.centres, bins.means, bins.errors)
        axes.errorbar(*means, fmt="o-", color=colour, label=label, linewidth=1.2, markersize=4, capsize=2)


def _titled(figure: Figure, panels: NDArray[np.object_], names: Sequence[str], unit: str, title: str) -> Figure:
    """The figure with the names of its rows and a title."""
    for axes, name in zip(panels[:, 0], names, strict=True):
        axes.set_ylabel(f"{name}, {unit}")
    figure.suptitle(title, size=11)
    return figure
