"""Runs a training from config to model, in each process of `ballfg-train`."""

import io
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ballfg.learning.config.training import TrainConfig
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.loop import Task, Training, TrainingStoppedError
from ballfg.learning.run.ranks import TOLD_BY_FIRST, Ranks, join_ranks
from ballfg.learning.run.run_folder import Checkpoint, read_checkpoint
from ballfg.learning.start import Start, calibrated_start
from ballfg.learning.trainee import TRAINEES, Prepared
from ballfg.progress import Watch, unwatched

if TYPE_CHECKING:
    from ballfg.learning.run.record import Record


def build(config: TrainConfig) -> Prepared:
    """The model of a config with its data, and the tracks that train and validate.

    Args: config: its key `kind` decides which registered kind builds the model.
    Raises: ValueError, FileNotFoundError: bad input.
    """
    return TRAINEES[config.kind].build(config)


def run_training(
    config: TrainConfig, folder: Path, *, resume: bool = False, watch: Watch = unwatched, command: str = ""
) -> int:
    """Train a model and write the folder of the run. Every process of a group calls this; the first one writes.

    Args:
        folder: to write; that of the earlier run to `resume` from its last checkpoint.
        watch: sees the batches pass in the first process, for instance to show progress.
        command: as it was typed, for the page; empty where it is not known.
    Returns: the exit status of `ballfg-train`: 0, or 1 if no epoch predicts the validation tracks better than the model
        before the first step.
    Raises:
        ValueError, FileNotFoundError: bad input, or a training that cannot go on (`TrainingStoppedError`).
        KeyboardInterrupt: after Ctrl-C; epochs up to the last checkpoint are kept, the best model so far is written.
        SystemExit: in the other processes, where the first one raises.
    """
    with join_ranks() as ranks, ExitStack() as stack:
        ranks.from_first(lambda: stack.enter_context(files.running(folder, config, resume=resume)))
        start = ranks.from_first(lambda: calibrated_start(config, folder, resume=resume, watch=watch))
        begun = config if start is None else config.model_copy(update={"model": str(start.base)})
        trainee, train, validation = ranks.together(lambda: _built(ranks, begun))
        # processes on machines of other kinds too begin with the same weights, bit for bit
        trainee.module.load_state_dict(ranks.from_first(trainee.module.state_dict))
        checkpoint = ranks.from_first(lambda: read_checkpoint(folder) if resume else None)
        task = Task(trainee, tuple(train), tuple(validation), config, ranks, watch)
        training = ranks.together(lambda: Training(task, checkpoint))
        record = ranks.together(lambda: _record(training, folder, checkpoint, command, start) if ranks.first else None)
        try:
            for epoch in training.epochs():
                due = epoch.epoch % config.checkpoint_every == 0 or epoch.epoch == config.optimizer.epochs
                kept = training.checkpoint() if due else None
                ranks.from_first(partial(record.write, epoch, kept) if record is not None else lambda: None)
            training.take_best()
            return ranks.from_first(lambda: 0 if record is None else record.finish())
        except TrainingStoppedError:
            if not ranks.first:
                raise SystemExit(TOLD_BY_FIRST) from None
            raise
        except KeyboardInterrupt:
            if record is not None:
                record.stop()
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


def _record(
    training: Training, folder: Path, checkpoint: Checkpoint | None, command: str, start: Start | None
) -> "Record":
    """Pictures and TensorBoard take half a second to import; processes other than the first do without."""
    from ballfg.learning.run.record import Record

    return Record(training, folder, checkpoint, command, start)
