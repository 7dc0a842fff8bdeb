"""Records a training in its first process: what each epoch gives, then the model, and a page on whether it helped."""

import math
import shlex
import sys
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch.utils.tensorboard import SummaryWriter

from ballfg.dynamics import load_model, save_model
from ballfg.estimation.noise.estimate import spread_over
from ballfg.files.whole_file import whole_file, write_text
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.loop import Training
from ballfg.learning.run.run_folder import Checkpoint, Epoch, epoch_line, read_metrics, write_checkpoint, write_metrics
from ballfg.learning.run.training_page import beside_untrained, improved, page, verdict
from ballfg.learning.start import NETWORK, Start
from ballfg.learning.trainee import PredictedShot
from ballfg.machine import date, versions
from ballfg.tracks.info import INFO_FILE, read_info

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
Points = list[tuple[int, float]]  # Epochs and values
TRAIN, VALIDATION, BEST = "#3b4cc0", "#d95f02", "#7f7f7f"
NOT_BETTER: Final = 1  # Exit status of a training that ended and whose model is not better than before
MOST_JUDGED: Final = 25  # Validation tracks that are judged one by one, to show the median one


class Record:
    """The files of a training, which the first process writes; command: as it was typed, or empty.

    Rows of epochs after the checkpoint from which the run continues are dropped, and those epochs run again.
    """

    def __init__(
        self,
        training: Training,
        folder: Path,
        checkpoint: Checkpoint | None,
        command: str,
        start: Start | None = None,
    ) -> None:
        task, self.start = training.task, start
        self.training, self.folder, self.command, self.last = training, folder, command, task.config.optimizer.epochs
        self.saved = -1 if checkpoint is None else checkpoint.progress.epoch
        rows = read_metrics(folder / files.METRICS) if checkpoint is not None else []
        self.epochs = [row for row in rows if row.epoch <= self.saved]
        self.taken: list[float] = []
        self.title = f"{task.config.kind}: {len(task.train)} tracks train, {len(task.validation)} validate"
        files.start(folder, task.config)
        self.tensorboard = SummaryWriter(str(folder / files.EVENTS), purge_step=self.saved + 1)
        print(f"{folder / files.CONFIG}: the config; {self.title}", flush=True)

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

    def finish(self) -> int:
        """Write the model with the best weights and the page, and print whether it helped. Returns: the exit status."""
        folder, progress, epochs, task = self.folder, self.training.progress, self.epochs, self.training.task
        model, beside, gains = self._export()
        if progress is None:
            return 0
        if self.start is None:
            judged = task.trainee.without_training(task.validation) if task.validation else None
            points = 0 if judged is None else judged.points
            untrained = math.sqrt(judged.squared_error / points) if judged is not None and points else None
            beside = f"{beside} {beside_untrained(epochs, progress.best_epoch, untrained)}".strip()
        self._write_page(model, self.median_shot() if gains else None, beside)
        better = gains and improved(epochs, progress.best_epoch)
        print(verdict(epochs, progress.best_epoch))
        print(beside, end="\n" if beside else "")
        if progress.best_rmse is not None:
            print(f"best: epoch {progress.best_epoch}, validation RMSE {1e3 * progress.best_rmse:.2f} mm")
        else:
            print("no validation track could be judged: the weights are those of the last epoch")
        kept = "the calibrated model" if self.start else "the model before the first step, which no epoch improved"
        what = kept if better is False else "the trained model"
        what += f", for {task.trainee.read_by}; no command reads it" if task.trainee.read_by else ""
        print(f"{folder / files.PAGE}: the training, to read")
        print(f"{model}: {what}\n{folder / files.METRICS}: all numbers\n{folder / files.CURVES}")
        return NOT_BETTER if better is False else 0

    def stop(self) -> None:
        """Write the best model so far after Ctrl-C, and list the kept files."""
        kept = "no epoch is kept yet" if self.saved < 0 else f"epochs up to {self.saved} are kept"
        print(f"{kept}; continue with --resume {self.folder}", file=sys.stderr, flush=True)
        if self.training.progress is None:
            print("no model is written: not even the first one had been judged", file=sys.stderr)
            return
        self.training.take_best()
        model, beside, _ = self._export()
        self._write_page(model, None, beside)
        print(f"{model}: the best model so far, of epoch {self.training.progress.best_epoch}", file=sys.stderr)

    def _export(self) -> tuple[Path, str, bool]:
        """Write the model: the network, or the calibrated one that it started from if it does not surely beat it.

        Returns: its path, a sentence on which model that is or on the comparison, or an empty one, and False for the
            calibrated model.
        """
        path = self.training.task.trainee.export(self.folder)
        if self.start is None:
            progress = self.training.progress
            first = progress is not None and improved(self.epochs, progress.best_epoch) is False
            return path, "The model file holds the model before the first step." if first else "", True
        choice = self.start.compare(path)
        gains = choice is not None and choice.chosen == NETWORK
        if not gains:
            save_model(load_model(self.start.calibrated), path)
        if choice is None:
            return path, "No validation track could be judged: the model file holds the calibrated model.", False
        print(choice.table())
        before, after = choice.candidates
        said = "surely predicts better than" if gains else "does not surely predict better than"
        left = "" if gains else ", which the model file holds"
        sentence = (
            f"The network {said} the calibrated model{left}: median errors are {1e3 * after.rmse_median:.1f} and "
            f"{1e3 * before.rmse_median:.1f} mm, the log score changes by {after.gained}."
        )
        return path, sentence, gains

    def _write_page(self, model: Path, shot: PredictedShot | None, beside: str) -> None:
        best = 0 if self.training.progress is None else self.training.progress.best_epoch
        data = self.training.task.config.data or ()
        words = ["ballfg", "predict", *(data[:1] or ["DATASET"]), "--model", str(model)]
        words += ["--observe", "0.3", "--out", "predictions.csv"]
        following = shlex.join(words) if model.is_file() else ""
        origin = {"made on": date()} | ({"command": self.command} if self.command else {}) | {"data": ", ".join(data)}
        origin["with"] = ", ".join(f"{name} {version}" for name, version in versions(files.PACKAGES).items())
        infos = [Path(folder) / INFO_FILE for folder in data]
        doubts = [doubt for info in infos if info.is_file() for doubt in read_info(info)[0].doubts]  # it may have moved
        drawn, learned = curves(self.epochs, self.title), self.training.task.trainee.learned()
        text = page(self.title, self.epochs, best, drawn, learned, shot, following, origin, beside, doubts)
        write_text(self.folder / files.PAGE, text)

    def median_shot(self) -> PredictedShot | None:
        """The validation track with the median error, of at most `MOST_JUDGED`, as the model predicts it."""
        task, errors = self.training.task, {}
        for track in spread_over(task.validation, len(task.validation), MOST_JUDGED):
            judged = task.trainee.judge([track])
            if judged.points and math.isfinite(judged.squared_error):
                errors[track] = judged.squared_error / judged.points
        ordered = sorted(errors, key=errors.__getitem__)
        return task.trainee.shown(ordered[(len(ordered) - 1) // 2]) if ordered else None


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
