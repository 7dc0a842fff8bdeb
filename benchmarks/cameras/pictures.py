"""Pictures of the cameras' benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ballfg.benchmarks.cameras.calibration import TURN, Nudge

BLUE, VERMILION = "#0072b2", "#d55e00"


def errors_picture(names: Sequence[str], errors: Sequence[NDArray[np.float64]], path: Path) -> Path:
    """How far points lie from the truth, a curve a recording: the share of points within a distance."""
    figure = Figure(figsize=(7.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, error in zip(names, errors, strict=True):
        distance = np.sort(1e3 * np.linalg.norm(error, axis=1))
        axes.plot(distance, np.arange(1, len(distance) + 1) / len(distance), label=f"{name} ({len(distance)} points)")
    axes.set(xscale="log", xlabel="distance from the truth, mm", ylabel="share of points within", ylim=(0, 1.01))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")
    axes.set_title("Rendered scenes, three 1280x720 cameras: points against the truth", size=11)
    figure.savefig(path, dpi=110)
    return path


def turns_picture(nudges: Sequence[Nudge], path: Path) -> Path:
    """The turn that is found of each camera that was turned, by axis; crossed out where another camera is named."""
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    axes = figure.subplots()
    for place, nudge in enumerate(nudges):
        right = nudge.named == nudge.camera
        axes.plot(place, nudge.turn, "o" if right else "x", color=BLUE if right else VERMILION, markersize=8)
    axes.axhline(TURN, color="black", linewidth=0.8, linestyle="--", label=f"turned by {TURN:g} degrees")
    axes.set_xticks(range(len(nudges)), [f"{n.camera}\n{n.axis}" for n in nudges], fontsize=8)
    axes.set(xlabel="camera, and the axis it was turned about", ylabel="turn found, degrees", ylim=(0, 2 * TURN))
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize=8)
    axes.set_title("A turned camera: named (dots) or not (crosses)", size=11)
    figure.savefig(path, dpi=110)
    return path
