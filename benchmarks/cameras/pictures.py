"""Draws the pictures of the cameras' benchmark."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from ballfg.benchmarks.cameras.turned import TURN, Turn
from ballfg.benchmarks.pictures import BLUE, ORANGE, save


def errors_picture(errors: Mapping[str, NDArray[np.float64]], path: Path) -> Path:
    """The share of points within a distance of the truth, a curve for the errors (n, 3) m of each recording."""
    figure, axes = plt.subplots(figsize=(7.4, 4.2), layout="constrained")
    for name, error in errors.items():
        distance = np.sort(1e3 * np.linalg.norm(error, axis=1))
        axes.plot(distance, np.arange(1, len(distance) + 1) / len(distance), label=f"{name} ({len(distance)} points)")
    axes.set(xscale="log", xlabel="distance from the truth, mm", ylabel="share of points within", ylim=(0, 1.01))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")
    axes.set_title("Rendered scenes, three 1280x720 cameras: points against the truth", size=11)
    return save(figure, path)


def turns_picture(turns: Sequence[Turn], path: Path) -> Path:
    """The turn that is found of each camera that was turned, by axis; crossed out where another camera is named."""
    figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
    for place, turn in enumerate(turns):
        right = turn.named == turn.camera
        axes.plot(place, turn.found, "o" if right else "x", color=BLUE if right else ORANGE, markersize=8)
    axes.axhline(TURN, color="black", linewidth=0.8, linestyle="--", label=f"turned by {TURN:g} degrees")
    axes.set_xticks(range(len(turns)), [f"{turn.camera}\n{turn.axis}" for turn in turns], fontsize=8)
    axes.set(xlabel="camera, and the axis it was turned about", ylabel="turn found, degrees", ylim=(0, 2 * TURN))
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize=8)
    axes.set_title("A turned camera: named (dots) or not (crosses)", size=11)
    return save(figure, path)
