"""Draws pictures of one shot for papers: views from the side and from above, and each axis by time."""

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from ballfg.arrays import Array
from ballfg.checks import drawn
from ballfg.pages.shot import HALF_WIDTH, ShownShot, unbroken
from ballfg.pages.shown import Outline

AXES: Final = ("x", "y", "z")
COLOURS: Final = {"estimate": "#0072b2", "prediction": "#d55e00"}
"""Okabe and Ito's blue and vermilion, distinct for every kind of colour vision."""
MEASURED, TABLE = "#555555", "#2f7d6b"
MARKERS: Final = {"contact": ("D", "#117733"), "hit": ("X", "#cc3311")}


def views(shot: ShownShot, table: Outline | None = None) -> Figure:
    """The shot from the side (x, z) and from above (x, y), with 90 % bands across the path.

    A shot that flies along y is drawn over y: (y, z) and (y, x).

    Args: shot: with samples, states or predictions.  table: its place, if known.
    """
    figure = Figure(figsize=(7.0, 5.6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    size = np.ptp(np.concatenate((shot.positions, shot.states[:, :3], shot.predicted)), axis=0)
    across = int(size[1] > size[0])
    for panel, up in zip(panels, (2, 1 - across), strict=True):
        _table(panel, table, across, up)
        _paths(panel, shot, across, up)
        panel.set_ylabel(f"{AXES[up]}, m")
        panel.grid(alpha=0.3)
        panel.set_aspect("equal", adjustable="datalim")
    panels[1].set_xlabel(f"{AXES[across]}, m")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=6, fontsize="small")
    return figure


def by_axis(shot: ShownShot) -> Figure:
    """x, y and z by time: measured, estimated and predicted, with 90 % bands."""
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    for a, panel in enumerate(panels):
        if len(shot.times):
            panel.plot(shot.times, shot.positions[:, a], ".", color=MEASURED, markersize=4, label="measured")
        for label, times, places, spread in shot.lines:
            if len(times):
                colour, variance = COLOURS[label], spread[:, a, a]
                width = HALF_WIDTH * np.sqrt(np.where(np.isfinite(variance), variance, np.nan))
                panel.plot(times, places[:, a], color=colour, linewidth=1.2, label=label)
                panel.fill_between(
                    times, places[:, a] - width, places[:, a] + width, color=colour, alpha=0.2, linewidth=0
                )
        for mark in shot.marks:
            panel.axvline(mark.time, color="0.5", linestyle="--" if mark.kind == "contact" else ":", linewidth=0.8)
        panel.set_ylabel(f"{AXES[a]}, m")
        panel.grid(alpha=0.3)
    panels[0].legend(ncols=3, fontsize="small")
    panels[0].set_title(f"track {drawn(shot.name)}: positions with 90 % intervals")
    panels[2].set_xlabel("time, s")
    return figure


def _table(panel: Axes, table: Outline | None, across: int, up: int) -> None:
    if table is None:
        return
    low, high = table.extent[2 * across : 2 * across + 2]
    if up == 2:
        panel.plot((low, high), (table.height, table.height), color=TABLE, linewidth=2.0, label="table")
    else:
        near, far = table.extent[2 * up : 2 * up + 2]
        panel.plot((low, high, high, low, low), (near, near, far, far, near), color=TABLE, linewidth=1.2, label="table")


def _paths(panel: Axes, shot: ShownShot, across: int, up: int) -> None:
    view = [across, up]
    if len(shot.times):
        panel.plot(*shot.positions[:, view].T, ".", color=MEASURED, markersize=4, label="measured")
    for label, _, places, spread in shot.lines:
        if len(places):
            panel.plot(*places[:, view].T, color=COLOURS[label], linewidth=1.2, label=label)
            bands = list(_bands(places[:, view], spread[:, view][:, :, view]))
            panel.add_collection(PolyCollection(bands, facecolor=COLOURS[label], alpha=0.25))
    for kind, (symbol, colour) in MARKERS.items():
        found = np.array([mark.place for mark in shot.marks if mark.kind == kind]).reshape(-1, 3)
        if len(found):
            panel.plot(*found[:, view].T, symbol, color=colour, markersize=5, label=kind)


def _bands(places: Array, covariances: Array) -> Array:
    """(m - 1, 4, 2) m, a quadrilateral of the band for each step; steps of unknown width are left out.

    Args: places: (m, 2) m.  covariances: (m, 2, 2) m^2.
    """
    return np.concatenate([np.zeros((0, 4, 2)), *(_band(places[run], covariances[run]) for run in unbroken(places))])


def _band(places: Array, covariances: Array) -> Array:
    """`_bands` of a path without a break."""
    along = np.gradient(places, axis=0)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack((-along[:, 1], along[:, 0]), axis=1) / np.where(length > 0.0, length, 1.0)
    variance = np.einsum("ni,nij,nj->n", across, covariances, across)
    offset = HALF_WIDTH * np.sqrt(np.maximum(variance, 0.0))[:, None] * across
    low, high = places - offset, places + offset
    pieces = np.stack((low[:-1], low[1:], high[1:], high[:-1]), axis=1)
    return np.asarray(pieces[np.isfinite(pieces).all(axis=(1, 2))])
