"""A training from config to model: what `ballfg-train` does in each of its processes."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from ballfg.learning.config.training import TrainConfig
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from ballfg.learning.run.curves import draw_curves
from ballfg.learning.run.loop import Task, Training, TrainingStoppedError
from ballfg.learning.run.metrics import Epoch, epoch_line, read_metrics, write_metrics
from ballfg.learning.run.ranks import TOLD_BY_FIRST, Ranks, join_ranks
from ballfg.learning.run.tensorboard import Events
from ballfg.learning.trainee import Trainee

if TYPE_CHECKING:
    from ballfg.learning.evaluation import Watch

Build = Callable[[TrainConfig], tuple[Trainee, Sequence[int], Sequence[int]]]
"""From a config to a model with its data, the numbers of the tracks that train, and of those that validate."""
Export = Callable[[Trainee, Path], Path]
"""Writes the model of a trainee into a folder; returns the file for `--model` of other commands."""


def run_training(
    config: TrainConfig, folder: Path, resume: bool, build: Build, export: Export, watch: Watch[list[int]]
) -> None:
    """Train, or continue to, and write a folder. Every process of a group calls it; the first one writes and prints.

    Raises:
        ValueError, FileNotFoundError: what the user can mend; TrainingStoppedError among them.
        KeyboardInterrupt: after Ctrl-C; the epochs up to the last checkpoint are kept.
        SystemExit: in the other processes, where the first one raises.
    """
    with join_ranks() as ranks:
        ranks.from_first(lambda: files.check(folder, config, resume=resume))
        trainee, train, validation = ranks.together(lambda: _built(ranks, config, build))
        # on machines of other kinds too, all begin with the same weights, bit for bit
        trainee.module.load_state_dict(ranks.from_first(trainee.module.state_dict))
        checkpoint = ranks.from_first(lambda: read_checkpoint(folder) if resume else None)
        task = Task(trainee, tuple(train), tuple(validation), config, ranks, watch)
        training = ranks.together(lambda: Training(task, checkpoint))
        record = ranks.together(lambda: _Record(task, folder, checkpoint) if ranks.first else None)
        try:
            for epoch in training.epochs():
                kept = training.checkpoint() if _is_due(epoch, config) else None
                ranks.from_first(partial(_write, record, epoch, kept))
            training.take_best()
            ranks.from_first(lambda: _finish(training, folder, export))
        except TrainingStoppedError:
            if not ranks.first:
                raise SystemExit(TOLD_BY_FIRST) from None
            raise
        except KeyboardInterrupt:
            if record is not None:
                print(f"{record.kept}; continue with --resume {folder}", file=sys.stderr)
            raise
        finally:
            if record is not None:
                record.close()


class _Record:
    """What the first process writes as the epochs come."""

    def __init__(self, task: Task, folder: Path, checkpoint: Checkpoint | None) -> None:
        """Write config and versions; of an earlier run's rows, keep those that the checkpoint knows of."""
        self.folder, self.last = folder, task.config.optimizer.epochs
        self.saved = -1 if checkpoint is None else checkpoint.progress.epoch
        rows = read_metrics(folder / files.METRICS) if checkpoint is not None else []
        self.epochs = [row for row in rows if row.epoch <= self.saved]
        self.taken: list[float] = []
        self.title = f"{task.config.kind}: {len(task.train)} tracks train, {len(task.validation)} validate"
        files.start(folder, task.config)
        self.events = Events(folder / files.EVENTS, self.saved + 1)
        print(f"{folder / files.CONFIG}: the config; {self.title}", flush=True)

    @property
    def kept(self) -> str:
        """What an interrupted run leaves."""
        return "no epoch is kept yet" if self.saved < 0 else f"epochs up to {self.saved} are kept"

    def write(self, epoch: Epoch, checkpoint: Checkpoint | None) -> None:
        """The row first, then the checkpoint: rows that no checkpoint knows of are taken again."""
        self.epochs.append(epoch)
        write_metrics(self.folder / files.METRICS, self.epochs)
        self.events.write(epoch)
        if checkpoint is not None:
            write_checkpoint(self.folder, checkpoint)
            self.saved = epoch.epoch
        if epoch.epoch:
            self.taken.append(epoch.seconds)
        left = (self.last - epoch.epoch) * fmean(self.taken) if self.taken else 0.0
        print(epoch_line(epoch, self.last, left), flush=True)

    def close(self) -> None:
        """Draw the curves and close the event files."""
        self.events.close()
        if self.epochs:
            draw_curves(self.epochs, self.title, self.folder / files.CURVES)


def _built(ranks: Ranks, config: TrainConfig, build: Build) -> tuple[Trainee, Sequence[int], Sequence[int]]:
    """Model and data; what is said of them is said once."""
    with ExitStack() as quiet:
        if not ranks.first:
            quiet.enter_context(redirect_stdout(io.StringIO()))
            quiet.enter_context(redirect_stderr(io.StringIO()))
        return build(config)


def _write(record: _Record | None, epoch: Epoch, checkpoint: Checkpoint | None) -> None:
    if record is not None:
        record.write(epoch, checkpoint)


def _is_due(epoch: Epoch, config: TrainConfig) -> bool:
    """Whether a checkpoint follows an epoch; the last one has one."""
    return epoch.epoch % config.checkpoint_every == 0 or epoch.epoch == config.optimizer.epochs


def _finish(training: Training, folder: Path, export: Export) -> None:
    """Write the model with the best weights and say what is where."""
    model = export(training.task.trainee, folder)
    progress = training.progress
    if progress is not None and progress.best_rmse is not None:
        print(f"best: epoch {progress.best_epoch}, validation RMSE {1e3 * progress.best_rmse:.2f} mm")
    else:
        print("no validation track could be judged: the weights are those of the last epoch")
    print(f"{model}: the trained model\n{folder / files.METRICS}: all numbers\n{folder / files.CURVES}")
