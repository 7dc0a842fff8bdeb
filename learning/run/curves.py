"""The picture of a training: loss and RMSE of the predicted positions over the epochs."""

from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ballfg.files.whole_file import whole_file
from ballfg.learning.run.metrics import Epoch

matplotlib.use("Agg")

Points = list[tuple[int, float]]
"""Epochs and values."""
DPI = 130
TRAIN, VALIDATION, BEST = "#3b4cc0", "#d95f02", "#7f7f7f"


def draw_curves(epochs: Sequence[Epoch], title: str, path: Path) -> None:
    """Write the picture as a PNG file."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.9), layout="constrained")
    losses = [(e.epoch, e.loss) for e in epochs if e.loss is not None]
    trained = [(e.epoch, 1e3 * e.train_rmse) for e in epochs if e.train_rmse is not None]
    judged = [(e.epoch, 1e3 * e.validation_rmse) for e in epochs if e.validation_rmse is not None]
    _curve(left, losses, TRAIN, "training tracks")
    _curve(right, trained, TRAIN, "training tracks")
    _curve(right, judged, VALIDATION, "validation tracks")
    if judged:
        best, least = min(judged, key=itemgetter(1))
        right.axhline(least, color=BEST, linewidth=0.8, linestyle="--", label=f"{least:.3g} mm at epoch {best}")
    _finish(left, "loss per track", losses)
    _finish(right, "RMSE of predicted positions, mm", trained + judged)
    figure.suptitle(title, size=11)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")
    plt.close(figure)


def _curve(axes: Axes, points: Points, colour: str, label: str) -> None:
    if points:
        axes.plot(*zip(*points, strict=True), ".-", color=colour, linewidth=1.2, markersize=4, label=label)


def _finish(axes: Axes, what: str, points: Points) -> None:
    """Labels, grid, and a logarithmic axis where all values are positive: a likelihood can make the loss negative."""
    axes.set(xlabel="epoch", ylabel=what)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if points and min(value for _, value in points) > 0.0:
        axes.set_yscale("log")
    axes.grid(visible=True, which="both", alpha=0.25)
    if points:
        axes.legend(fontsize="x-small")
