"""Records a training after each epoch: metrics, curves, TensorBoard, checkpoints, a line of text."""

from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch.utils.tensorboard import SummaryWriter

from ballfg.files.whole_file import whole_file
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.checkpoint import Checkpoint, write_checkpoint
from ballfg.learning.run.loop import Task
from ballfg.learning.run.metrics import Epoch, epoch_line, read_metrics, write_metrics

SCALARS = {
    "loss/train": ("loss", 1.0),
    "rmse_mm/train": ("train_rmse", 1e3),
    "rmse_mm/validation": ("validation_rmse", 1e3),
    "optimizer/learning_rate": ("learning_rate", 1.0),
    "optimizer/gradient_norm": ("gradient_norm", 1.0),
    "tracks/failed": ("failed", 1.0),
    "tracks/validation_failed": ("validation_failed", 1.0),
    "steps/skipped": ("skipped", 1.0),
    "time/seconds": ("seconds", 1.0),
}
"""Name of each TensorBoard curve, the number of an epoch that it shows, and its scale."""
Points = list[tuple[int, float]]
"""Epochs and values."""
TRAIN, VALIDATION, BEST = "#3b4cc0", "#d95f02", "#7f7f7f"


class Record:
    """The files of a training, which the first process writes.

    Rows of epochs after the checkpoint from which the run continues are dropped, and those epochs run again.
    """

    def __init__(self, task: Task, folder: Path, checkpoint: Checkpoint | None) -> None:
        self.folder, self.last = folder, task.config.optimizer.epochs
        self.saved = -1 if checkpoint is None else checkpoint.progress.epoch
        rows = read_metrics(folder / files.METRICS) if checkpoint is not None else []
        self.epochs = [row for row in rows if row.epoch <= self.saved]
        self.taken: list[float] = []
        self.title = f"{task.config.kind}: {len(task.train)} tracks train, {len(task.validation)} validate"
        files.start(folder, task.config)
        self.tensorboard = SummaryWriter(str(folder / files.EVENTS), purge_step=self.saved + 1)
        print(f"{folder / files.CONFIG}: the config; {self.title}", flush=True)

    @property
    def kept(self) -> str:
        """The epochs that an interrupted run keeps, in words."""
        return "no epoch is kept yet" if self.saved < 0 else f"epochs up to {self.saved} are kept"

    def write(self, epoch: Epoch, checkpoint: Checkpoint | None) -> None:
        """Write the row first and then the checkpoint: rows after the last checkpoint are computed again."""
        self.epochs.append(epoch)
        write_metrics(self.folder / files.METRICS, self.epochs)
        for name, (attribute, scale) in SCALARS.items():
            value = getattr(epoch, attribute)
            if value is not None:
                self.tensorboard.add_scalar(name, scale * value, epoch.epoch)
        self.tensorboard.flush()
        if checkpoint is not None:
            write_checkpoint(self.folder, checkpoint)
            self.saved = epoch.epoch
        if epoch.epoch:
            self.taken.append(epoch.seconds)
        left = (self.last - epoch.epoch) * fmean(self.taken) if self.taken else 0.0
        print(epoch_line(epoch, self.last, left), flush=True)

    def close(self) -> None:
        """Draw the curves and close the event files."""
        self.tensorboard.close()
        if self.epochs:
            with whole_file(self.folder / files.CURVES) as temporary:
                curves(self.epochs, self.title).savefig(temporary, dpi=130, format="png")


def curves(epochs: Sequence[Epoch], title: str) -> Figure:
    """Loss and RMSE of the predicted positions over the epochs."""
    figure = Figure(figsize=(9.6, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    losses = [(e.epoch, e.loss) for e in epochs if e.loss is not None]
    trained = [(e.epoch, 1e3 * e.train_rmse) for e in epochs if e.train_rmse is not None]
    judged = [(e.epoch, 1e3 * e.validation_rmse) for e in epochs if e.validation_rmse is not None]
    for axes, points, colour, label in (
        (left, losses, TRAIN, "training tracks"),
        (right, trained, TRAIN, "training tracks"),
        (right, judged, VALIDATION, "validation tracks"),
    ):
        if points:
            axes.plot(*zip(*points, strict=True), ".-", color=colour, linewidth=1.2, markersize=4, label=label)
    if judged:
        best, least = min(judged, key=itemgetter(1))
        right.axhline(least, color=BEST, linewidth=0.8, linestyle="--", label=f"{least:.3g} mm at epoch {best}")
    _finish(left, "loss per track", losses)
    _finish(right, "RMSE of predicted positions, mm", trained + judged)
    figure.suptitle(title, size=11)
    return figure


def _finish(axes: Axes, what: str, points: Points) -> None:
    """Labels, grid, and a logarithmic axis where all values are positive: a likelihood can make the loss negative."""
    axes.set(xlabel="epoch", ylabel=what)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if points and min(value for _, value in points) > 0.0:
        axes.set_yscale("log")
    axes.grid(visible=True, which="both", alpha=0.25)
    if points:
        axes.legend(fontsize="x-small")
