"""The training loop sums the gradients of each batch of tracks, takes a step, and judges validation tracks.

`Training.epochs` is the loop. Random numbers derive from seed and epoch, so that a loop which continues from a
checkpoint takes the same steps, bit for bit.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn

from ballfg.checks import listed
from ballfg.learning.config.training import OptimizerConfig, TrainConfig
from ballfg.learning.run.ranks import Ranks, SharedMemory
from ballfg.learning.run.run_folder import Checkpoint, Epoch, RunProgress, data_digest
from ballfg.learning.trainee import BatchLoss, Trainee
from ballfg.progress import Watch


class TrainingStoppedError(ValueError):
    """The training cannot go on, for the reason in its text. The last checkpoint is kept."""


@dataclass(frozen=True)
class Task:
    """A model with its data, the tracks that train and that validate (maybe none), processes that share the work.

    `watch` sees the batches pass in the first process, to show progress.
    """

    trainee: Trainee
    train: tuple[int, ...]
    validation: tuple[int, ...]
    config: TrainConfig
    ranks: Ranks
    watch: Watch


@dataclass
class _Tally:
    """Sums over the tracks of all ranks, and the tracks that failed on this rank."""

    loss: float = 0.0
    tracks: float = 0.0
    squared_error: float = 0.0
    points: float = 0.0
    failed: float = 0.0
    skipped: int = 0
    norms: list[float] = field(default_factory=list)
    reasons: list[tuple[str, str]] = field(default_factory=list)

    @property
    def rmse(self) -> float | None:
        """m; None without a finite sum."""
        mean = self.squared_error / self.points if self.points else math.nan
        return math.sqrt(mean) if math.isfinite(mean) else None


class Training:
    """A run from its start or from a checkpoint. Every rank of `task.ranks` calls the same methods in the same order.

    Raises: ValueError: a checkpoint of another run.
    """

    def __init__(self, task: Task, checkpoint: Checkpoint | None = None) -> None:
        self.task, self.module = task, task.trainee.module
        self.optimizer = make_optimizer(task.trainee, task.config.optimizer)
        self.parameters = [parameter for group in self.optimizer.param_groups for parameter in group["params"]]
        self.progress: RunProgress | None = None
        self.best = _weights(self.module)
        self.memory = SharedMemory()
        self.skipped_in_row = 0
        self.data = data_digest(task.config.data or ())
        if checkpoint is not None:
            self._restore(checkpoint)

    def epochs(self) -> Iterator[Epoch]:
        """The epochs that are left, and in a new run epoch 0, which judges the model before the first step.

        Raises: TrainingStoppedError: too many tracks failed, or too many steps in a row were not finite.
        """
        done = -1 if self.progress is None else self.progress.epoch
        for number in range(done + 1, self.task.config.optimizer.epochs + 1):
            begun = time.monotonic()
            learned = self._learn(number) if number else _Tally()
            judged = self._judge(number)
            self._note(number, judged)
            yield Epoch(
                epoch=number,
                loss=learned.loss / learned.tracks if learned.tracks else None,
                train_rmse=learned.rmse,
                validation_rmse=judged.rmse,
                learning_rate=self._rate(number - 1, self._batches - 1) if number else 0.0,
                gradient_norm=float(np.mean(learned.norms)) if learned.norms else None,
                skipped=learned.skipped,
                failed=int(learned.failed),
                validation_failed=int(judged.failed),
                seconds=time.monotonic() - begun,
            )

    def checkpoint(self) -> Checkpoint:
        """The run after its last epoch. All ranks call it, between epochs only."""
        if self.progress is None:
            raise ValueError("a checkpoint must follow an epoch; got none yet. Take the first of `epochs` before.")
        memory = self.memory.gather(self.task.ranks, self.task.trainee.memory())
        return Checkpoint(self.progress, _weights(self.module), self.best, moments(self.optimizer, self.module), memory)

    def take_best(self) -> None:
        """Put the best weights into the model."""
        self.module.load_state_dict(self.best)

    @property
    def _batches(self) -> int:
        """Steps of an epoch."""
        return -(-len(self.task.train) // self.task.config.optimizer.batch)

    def _learn(self, number: int) -> _Tally:
        """One pass over the training tracks, in the random order of the epoch."""
        tally, epoch = _Tally(), number - 1
        rng = np.random.default_rng((self.task.config.seed, epoch))
        order = rng.permutation(np.array(self.task.train)).tolist()
        for index, batch in enumerate(self._batches_of(order, f"batches of epoch {number}")):
            for group in self.optimizer.param_groups:
                group["lr"] = group["scale"] * self._rate(epoch, index)
            self._step(batch, epoch, tally)
        return tally

    def _step(self, batch: Sequence[int], epoch: int, tally: _Tally) -> None:
        """Sum the gradients of a batch over all ranks and take a step, unless it is not finite."""
        task = self.task
        summed = task.ranks.sum(task.ranks.together(lambda: self._gradients(batch, epoch, tally)))
        gradient, (loss, tracks, squared_error, points, failed) = summed[:-5], summed[-5:].tolist()
        tally.failed += failed
        self._check_failures(tally)
        if not tracks:
            return
        if not bool(summed.isfinite().all()):
            tally.skipped += 1
            self.skipped_in_row += 1
            if self.skipped_in_row > task.config.diverged_limit:
                raise TrainingStoppedError(
                    f"training diverged: loss or gradient was not finite in {self.skipped_in_row} steps in a row. "
                    "Set optimizer.learning_rate lower, or loss.horizon shorter."
                )
            return
        self.skipped_in_row = 0
        tally.loss += loss
        tally.tracks += tracks
        tally.squared_error += squared_error
        tally.points += points
        gradient = gradient / tracks
        norm = float(gradient.norm())
        tally.norms.append(norm)
        clip = task.config.optimizer.clip
        gradient = gradient * (clip / norm) if clip is not None and norm > clip else gradient
        parts = gradient.split([parameter.numel() for parameter in self.parameters])
        for parameter, part in zip(self.parameters, parts, strict=True):
            parameter.grad = part.view_as(parameter).to(parameter.dtype)
        self.optimizer.step()
        task.trainee.after_step()

    def _gradients(self, batch: Sequence[int], epoch: int, tally: _Tally) -> Tensor:
        """The gradient of this rank's share of a batch as a flat vector, followed by the five sums of the share."""
        own = self.task.ranks.own(batch)
        self.optimizer.zero_grad()
        found = self.task.trainee.loss(own, epoch) if own else BatchLoss.none()
        if found.total.requires_grad:
            found.total.backward()
        tally.reasons += found.failed
        flat = [p.new_zeros(p.numel()) if p.grad is None else p.grad.reshape(-1) for p in self.parameters]
        return torch.cat([part.double() for part in flat] + [_sums(found)])

    def _check_failures(self, tally: _Tally) -> None:
        """Stop as soon as more tracks of the epoch have failed than the config allows."""
        limit, count = self.task.config.failure_limit, len(self.task.train)
        if tally.failed <= limit * count:
            return
        name, reason = next(each for reasons in self.task.ranks.gather(tally.reasons) for each in reasons)
        raise TrainingStoppedError(
            f"more than {100 * limit:g} % of the {count} training tracks failed in one epoch, the first one '{name}': "
            f"{reason}. Raise failure_limit to go on without them."
        )

    def _judge(self, number: int) -> _Tally:
        ranks = self.task.ranks

        def work() -> Tensor:
            sums = torch.zeros(5, dtype=torch.float64)
            for part in self._batches_of(ranks.own(self.task.validation), f"batches judged after epoch {number}"):
                sums += _sums(self.task.trainee.judge(part))
            return sums

        loss, tracks, squared_error, points, failed = ranks.sum(ranks.together(work)).tolist()
        return _Tally(loss, tracks, squared_error, points, failed)

    def _note(self, number: int, judged: _Tally) -> None:
        """Keep the weights if they are the best so far. An epoch in which too many tracks failed does not count."""
        reliable = judged.failed <= self.task.config.failure_limit * len(self.task.validation)
        rmse = judged.rmse if reliable else None
        best = None if self.progress is None else self.progress.best_rmse
        better = best is None or (rmse is not None and rmse < best)
        if better:
            self.best = _weights(self.module)
        self.progress = RunProgress(
            epoch=number,
            best_epoch=number if better or self.progress is None else self.progress.best_epoch,
            best_rmse=rmse if better else best,
            skipped_in_row=self.skipped_in_row,
            train=len(self.task.train),
            validation=len(self.task.validation),
            data=self.data,
        )

    def _rate(self, epoch: int, index: int) -> float:
        settings = self.task.config.optimizer
        return settings.learning_rate * rate_factor(settings, epoch * self._batches + index, self._batches)

    def _batches_of(self, tracks: list[int], what: str) -> Iterator[list[int]]:
        """Batches of tracks, whose progress the first process shows."""
        size = self.task.config.optimizer.batch
        batches = [tracks[i : i + size] for i in range(0, len(tracks), size)]
        return self.task.watch(batches, len(batches), what) if self.task.ranks.first else iter(batches)

    def _restore(self, checkpoint: Checkpoint) -> None:
        """Restore a checkpoint. Raises: ValueError: if it is of another model or other tracks."""
        checkpoint = checkpoint.renamed(self.module.state_dict())
        progress, task = checkpoint.progress, self.task
        there, here = (progress.train, progress.validation), (len(task.train), len(task.validation))
        if there != here:
            raise ValueError(
                f"the checkpoint must be of the same tracks; it has {there[0]} to train and {there[1]} to validate, "
                f"the data {here[0]} and {here[1]}. Give the same data, or start a new run."
            )
        if progress.data not in (None, self.data):
            raise ValueError(
                f"the checkpoint must be of the same data; dataset.yaml or a table of {listed(task.config.data or ())} "
                "has changed since. Restore it, or start a new run."
            )
        try:
            self.module.load_state_dict(checkpoint.weights)
            parameters = dict(self.module.named_parameters())
            for name, tensor in checkpoint.optimizer.items():
                parameter, _, moment = name.rpartition("/")
                self.optimizer.state[parameters[parameter]][moment] = tensor.clone()
        except (RuntimeError, KeyError) as error:  # torch raises these for names and shapes that differ
            raise ValueError(f"the checkpoint must be of the same model; {error}. Start a new run.") from None
        task.trainee.remember(checkpoint.memory)
        self.memory = SharedMemory(checkpoint.memory)
        self.progress, self.best, self.skipped_in_row = progress, checkpoint.best, progress.skipped_in_row


def _sums(found: BatchLoss) -> Tensor:
    """(5,) the sums that ranks add up: loss, tracks, squared error, points, failed tracks."""
    row = (float(found.total.detach()), found.tracks, found.squared_error, found.points, len(found.failed))
    return torch.tensor(row, dtype=torch.float64)


def _weights(module: nn.Module) -> dict[str, Tensor]:
    """A copy of a module's state."""
    return {name: tensor.detach().clone() for name, tensor in module.state_dict().items()}


def make_optimizer(trainee: Trainee, settings: OptimizerConfig) -> torch.optim.AdamW:
    """AdamW over the trainee's groups. Raises: ValueError: if one holds a parameter that the module does not name."""
    groups = trainee.groups()
    named = {id(parameter) for parameter in trainee.module.parameters()}
    for group in groups:
        if any(id(parameter) not in named for parameter in group["params"]):
            raise ValueError(f"group '{group['name']}' must hold parameters of the module; got another. Register it.")
    return torch.optim.AdamW(groups, lr=settings.learning_rate, weight_decay=settings.weight_decay)


def rate_factor(settings: OptimizerConfig, step: int, per_epoch: int) -> float:
    """Share of the full learning rate at a step, counted from 0 over all epochs."""
    warm, total = settings.warm_start_epochs * per_epoch, settings.epochs * per_epoch
    if step < warm:
        return (step + 1) / warm
    if settings.schedule == "constant":
        return 1.0
    return 0.5 * (1.0 + math.cos(math.pi * (step - warm) / (total - warm)))


def moments(optimizer: torch.optim.Optimizer, module: nn.Module) -> dict[str, Tensor]:
    """A copy of the optimizer's state, as `<parameter>/<moment>`."""
    return {
        f"{name}/{key}": tensor.clone()
        for name, parameter in module.named_parameters()
        if parameter in optimizer.state
        for key, tensor in optimizer.state[parameter].items()
    }
