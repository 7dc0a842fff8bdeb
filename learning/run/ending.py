"""Ends a training in its first process: it writes the model and the page, and says whether it helped."""

import math
import shlex
import sys
from pathlib import Path
from typing import Final

from ballfg.estimation.noise.estimate import spread_over
from ballfg.files.whole_file import write_text
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.loop import Task, Training
from ballfg.learning.run.record import Record, curves
from ballfg.learning.run.training_page import beside_untrained, improved, page, verdict
from ballfg.learning.trainee import PredictedShot
from ballfg.machine import date, versions

NOT_BETTER: Final = 1
"""Exit status of a training that ended and whose model is not better than before."""
MOST_JUDGED: Final = 25
"""Validation tracks that are judged one by one, to show the median one."""


def finish(training: Training, record: Record, command: str) -> int:
    """Write the model with the best weights and the page, and print whether it helped. Returns: the exit status."""
    folder, progress, epochs, task = record.folder, training.progress, record.epochs, training.task
    model = task.trainee.export(folder)
    if progress is None:
        return 0
    judged = task.trainee.without_training(task.validation) if task.validation else None
    untrained = math.sqrt(judged.squared_error / judged.points) if judged is not None and judged.points else None
    _write_page(training, record, model, command, median_shot(task), untrained)
    better = improved(epochs, progress.best_epoch)
    print(verdict(epochs, progress.best_epoch))
    beside = beside_untrained(epochs, progress.best_epoch, untrained)
    print(beside, end="\n" if beside else "")
    if progress.best_rmse is not None:
        print(f"best: epoch {progress.best_epoch}, validation RMSE {1e3 * progress.best_rmse:.2f} mm")
    else:
        print("no validation track could be judged: the weights are those of the last epoch")
    what = "the model before the first step, which no epoch improved" if better is False else "the trained model"
    print(f"{folder / files.PAGE}: the training, to read")
    print(f"{model}: {what}\n{folder / files.METRICS}: all numbers\n{folder / files.CURVES}")
    return NOT_BETTER if better is False else 0


def stop(training: Training, record: Record, command: str) -> None:
    """Writes the best model so far after Ctrl-C, and lists the kept files."""
    print(f"{record.kept}; continue with --resume {record.folder}", file=sys.stderr, flush=True)
    if training.progress is None:
        print("no model is written: not even the first one had been judged", file=sys.stderr)
        return
    training.take_best()
    model = training.task.trainee.export(record.folder)
    _write_page(training, record, model, command, None, None)
    print(f"{model}: the best model so far, of epoch {training.progress.best_epoch}", file=sys.stderr)


def _write_page(
    training: Training, record: Record, model: Path, command: str, shot: PredictedShot | None, untrained: float | None
) -> None:
    best = 0 if training.progress is None else training.progress.best_epoch
    data = training.task.config.data or ()
    words = ["ballfg", "predict", *(data[:1] or ["DATASET"]), "--model", str(model)]
    words += ["--observe", "0.3", "--out", "predictions.csv"]
    following = shlex.join(words) if model.is_file() else ""
    origin = {"made on": date()} | ({"command": command} if command else {}) | {"data": ", ".join(data)}
    origin["with"] = ", ".join(f"{name} {version}" for name, version in versions(files.PACKAGES).items())
    drawn, learned = curves(record.epochs, record.title), training.task.trainee.learned()
    text = page(record.title, record.epochs, best, drawn, learned, shot, following, origin, untrained)
    write_text(record.folder / files.PAGE, text)


def median_shot(task: Task) -> PredictedShot | None:
    """The validation track with the median error, of at most `MOST_JUDGED`, as the model predicts it."""
    tracks, errors = spread_over(task.validation, len(task.validation), MOST_JUDGED), {}
    for track in tracks:
        judged = task.trainee.judge([track])
        if judged.points and math.isfinite(judged.squared_error):
            errors[track] = judged.squared_error / judged.points
    ordered = sorted(errors, key=errors.__getitem__)
    return task.trainee.shown(ordered[(len(ordered) - 1) // 2]) if ordered else None
