"""A training from config to model: the work of `ballfg-train` in each of its processes."""

import io
import math
import shlex
import sys
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Final

from ballfg.estimation import spread_over
from ballfg.files.whole_file import write_text
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.registry import TRAINEES
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.checkpoint import Checkpoint, read_checkpoint
from ballfg.learning.run.loop import Task, Training, TrainingStoppedError
from ballfg.learning.run.metrics import Epoch
from ballfg.learning.run.ranks import TOLD_BY_FIRST, Ranks, join_ranks
from ballfg.learning.run.record import Record, curves
from ballfg.learning.run.training_page import beside_untrained, improved, page, verdict
from ballfg.learning.trainee import PredictedShot, Prepared
from ballfg.machine import date, versions
from ballfg.progress import Watch, unwatched

NOT_BETTER: Final = 1
"""Exit status of a training that ended and whose model is not better than before."""
MOST_JUDGED: Final = 25
"""Validation tracks that are judged one by one, to show the median one."""


def build(config: TrainConfig) -> Prepared:
    """The model of a config with its data, and the tracks that train and validate.

    Args: config: its key `kind` decides which registered kind builds the model.
    Raises: ValueError, FileNotFoundError: bad input.
    """
    return TRAINEES[config.kind].build(config)


def run_training(
    config: TrainConfig, folder: Path, *, resume: bool = False, watch: Watch = unwatched, command: str = ""
) -> int:
    """Train a model and write the folder of the run.

    Every process of a group calls this; the first one writes and prints.

    Returns: the exit status of `ballfg-train`: 0, or `NOT_BETTER` if no epoch predicts the validation tracks better
        than the model before the first step.

    Args:
        config: of the training.
        folder: to write; that of the earlier run if it is to `resume`.
        resume: continue from the last checkpoint.
        watch: sees the batches pass in the first process, for instance to show progress.
        command: as it was typed, for the page; empty where it is not known.
    Raises:
        ValueError, FileNotFoundError: bad input, or a training that cannot go on (`TrainingStoppedError`).
        KeyboardInterrupt: after Ctrl-C; the epochs up to the last checkpoint are kept, and the best model so far is
            written.
        SystemExit: in the other processes, where the first one raises.
    """
    with join_ranks() as ranks, ExitStack() as stack:
        ranks.from_first(partial(_enter, stack, folder, config, resume))
        trainee, train, validation = ranks.together(lambda: _built(ranks, config))
        # processes on machines of other kinds too begin with the same weights, bit for bit
        trainee.module.load_state_dict(ranks.from_first(trainee.module.state_dict))
        checkpoint = ranks.from_first(lambda: read_checkpoint(folder) if resume else None)
        task = Task(trainee, tuple(train), tuple(validation), config, ranks, watch)
        training = ranks.together(lambda: Training(task, checkpoint))
        record = ranks.together(lambda: Record(task, folder, checkpoint) if ranks.first else None)
        try:
            for epoch in training.epochs():
                due = epoch.epoch % config.checkpoint_every == 0 or epoch.epoch == config.optimizer.epochs
                kept = training.checkpoint() if due else None
                ranks.from_first(partial(_write, record, epoch, kept))
            training.take_best()
            return ranks.from_first(lambda: _finish(training, record, folder, command))
        except TrainingStoppedError:
            if not ranks.first:
                raise SystemExit(TOLD_BY_FIRST) from None
            raise
        except KeyboardInterrupt:
            if record is not None:
                _stop(training, record, folder, command)
            raise
        finally:
            if record is not None:
                record.close()


def _enter(stack: ExitStack, folder: Path, config: TrainConfig, resume: bool) -> None:
    """Keep other runs from the folder until the stack is closed."""
    stack.enter_context(files.running(folder, config, resume=resume))


def _built(ranks: Ranks, config: TrainConfig) -> Prepared:
    """Model and data; only the first process prints notes on them."""
    with ExitStack() as quiet:
        if not ranks.first:
            quiet.enter_context(redirect_stdout(io.StringIO()))
            quiet.enter_context(redirect_stderr(io.StringIO()))
        return build(config)


def _write(record: Record | None, epoch: Epoch, checkpoint: Checkpoint | None) -> None:
    if record is not None:
        record.write(epoch, checkpoint)


def _finish(training: Training, record: Record | None, folder: Path, command: str) -> int:
    """Write the model with the best weights and the page, and print whether it helped. Returns: the exit status."""
    model = training.task.trainee.export(folder)
    progress, epochs = training.progress, [] if record is None else record.epochs
    if progress is None or record is None:
        return 0
    shot = median_shot(training.task)
    untrained = _untrained(training.task)
    _write_page(training, record, folder, model, command, shot, untrained)
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


def _stop(training: Training, record: Record, folder: Path, command: str) -> None:
    """Write the best model so far after Ctrl-C, and say what is kept."""
    print(f"{record.kept}; continue with --resume {folder}", file=sys.stderr, flush=True)
    if training.progress is None:
        print("no model is written: not even the first one had been judged", file=sys.stderr)
        return
    training.take_best()
    model = training.task.trainee.export(folder)
    _write_page(training, record, folder, model, command, None)
    print(f"{model}: the best model so far, of epoch {training.progress.best_epoch}", file=sys.stderr)


def _untrained(task: Task) -> float | None:
    """RMSE of the model that one has without a training on the validation tracks, m; None where there is no other."""
    judged = task.trainee.without_training(task.validation) if task.validation else None
    return math.sqrt(judged.squared_error / judged.points) if judged is not None and judged.points else None


def _write_page(
    training: Training,
    record: Record,
    folder: Path,
    model: Path,
    command: str,
    shot: PredictedShot | None,
    untrained: float | None = None,
) -> None:
    best = 0 if training.progress is None else training.progress.best_epoch
    data = training.task.config.data
    dataset = data[0] if data else "DATASET"
    following = (
        shlex.join(
            ["ballfg", "predict", dataset, "--model", str(model), "--observe", "0.3", "--out", "predictions.csv"]
        )
        if model.is_file()
        else ""
    )
    origin = {"made on": date()} | ({"command": command} if command else {}) | {"data": ", ".join(data or ())}
    origin["with"] = ", ".join(f"{name} {version}" for name, version in versions(files.PACKAGES).items())
    drawn, learned = curves(record.epochs, record.title), training.task.trainee.learned()
    text = page(record.title, record.epochs, best, drawn, learned, shot, following, origin, untrained)
    write_text(folder / files.PAGE, text)


def median_shot(task: Task) -> PredictedShot | None:
    """The validation track with the median error, of at most `MOST_JUDGED`, as the model predicts it."""
    tracks, errors = spread_over(task.validation, len(task.validation), MOST_JUDGED), {}
    for track in tracks:
        judged = task.trainee.judge([track])
        if judged.points and math.isfinite(judged.squared_error):
            errors[track] = judged.squared_error / judged.points
    ordered = sorted(errors, key=errors.__getitem__)
    return task.trainee.shown(ordered[(len(ordered) - 1) // 2]) if ordered else None
