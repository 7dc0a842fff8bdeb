"""A training from config to model: the work of `ballfg-train` in each of its processes."""

import io
import sys
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path

from ballfg.learning.config.training import TrainConfig
from ballfg.learning.registry import TRAINEES
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.checkpoint import Checkpoint, read_checkpoint
from ballfg.learning.run.loop import Task, Training, TrainingStoppedError
from ballfg.learning.run.metrics import Epoch
from ballfg.learning.run.ranks import TOLD_BY_FIRST, Ranks, join_ranks
from ballfg.learning.run.record import Record
from ballfg.learning.trainee import Prepared
from ballfg.progress import Watch, unwatched


def build(config: TrainConfig) -> Prepared:
    """The model of a config with its data, and the tracks that train and validate.

    Args: config: its key `kind` decides which registered kind builds the model.
    Raises: ValueError, FileNotFoundError: bad input.
    """
    return TRAINEES[config.kind].build(config)


def run_training(config: TrainConfig, folder: Path, *, resume: bool = False, watch: Watch = unwatched) -> None:
    """Train a model and write the folder of the run.

    Every process of a group calls this; the first one writes and prints.

    Args:
        config: of the training.
        folder: to write; that of the earlier run if it is to `resume`.
        resume: continue from the last checkpoint.
        watch: sees the batches pass in the first process, for instance to show progress.
    Raises:
        ValueError, FileNotFoundError: bad input, or a training that cannot go on (`TrainingStoppedError`).
        KeyboardInterrupt: after Ctrl-C; the epochs up to the last checkpoint are kept.
        SystemExit: in the other processes, where the first one raises.
    """
    with join_ranks() as ranks:
        ranks.from_first(lambda: files.check(folder, config, resume=resume))
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
            ranks.from_first(lambda: _finish(training, folder))
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


def _finish(training: Training, folder: Path) -> None:
    """Write the model with the best weights, and print the paths of the results."""
    model = training.task.trainee.export(folder)
    progress = training.progress
    if progress is not None and progress.best_rmse is not None:
        print(f"best: epoch {progress.best_epoch}, validation RMSE {1e3 * progress.best_rmse:.2f} mm")
    else:
        print("no validation track could be judged: the weights are those of the last epoch")
    print(f"{model}: the trained model\n{folder / files.METRICS}: all numbers\n{folder / files.CURVES}")
