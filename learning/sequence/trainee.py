"""Adapts a sequence model with its tracks to the training loop."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, cast

import torch
from torch import Tensor

from ballfg.learning.augment import augmentation
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.registry import TraineeKind
from ballfg.learning.sequence.architecture import SequenceArchitecture, SequenceKind
from ballfg.learning.sequence.data import Batch, Example, LauncherSettings, collate, example
from ballfg.learning.sequence.model import SequenceModel
from ballfg.learning.sequence.predictor import SequencePredictor
from ballfg.learning.shots import TrainingShot
from ballfg.learning.trainee import BatchLoss, PredictedShot, Prepared, Trainee
from ballfg.learning.training_data import read_training_data
from ballfg.tracks import Track

FOLDER = "model"
"""Folder of the predictor, in that of a training."""


class SequenceTrainee(Trainee):
    """Trains an LSTM or diffusion model to predict the unobserved rest of tracks.

    A track that cannot be used - too short, launcher settings missing - counts as failed in each batch.

    Args:
        observed: number of observed samples of each.
        train: numbers of the training tracks, from which the model takes its scales; at least one that can be used.
        architecture: kind and size.
        launcher: its labels.
        seed: of initial weights, augmentation and diffusion noise, >= 0.
        augment: True to rotate and shift training tracks.
    Raises: ValueError: if no track of the training part can be used.
    """

    module: SequenceModel

    def __init__(
        self,
        tracks: Sequence[Track],
        observed: Sequence[int],
        train: Sequence[int],
        *,
        architecture: SequenceArchitecture,
        launcher: LauncherSettings,
        seed: int,
        augment: bool,
    ) -> None:
        self._names = [track.name for track in tracks]
        self._examples: dict[int, Example] = {}
        self._unusable: dict[int, str] = {}
        for number, (track, count) in enumerate(zip(tracks, observed, strict=True)):
            try:
                self._examples[number] = example(track, count, launcher.of(track))
            except ValueError as error:
                self._unusable[number] = str(error)
        usable = [self._examples[number] for number in train if number in self._examples]
        if not usable:
            reason = next((self._unusable[number] for number in train), "it is empty")
            raise ValueError(f"train must hold a track with observations and a rest; got none ({reason})")
        self.module = architecture.untrained(usable, seed)
        self._architecture, self._launcher = architecture, launcher
        self._seed = seed
        self._augment = augment

    def loss(self, tracks: Sequence[int], epoch: int) -> BatchLoss:
        """Sum of the tracks' losses, in squared units of the frame; lstm: squared error, diffusion: denoising.

        `squared_error` is that of the positions predicted in training; diffusion: of the denoised paths.
        """
        numbers = [number for number in tracks if number in self._examples]
        if not numbers:
            return BatchLoss.none(self._failed(tracks))
        examples = [self._examples[number] for number in numbers]
        if self._augment:
            poses = [augmentation(self._seed, epoch, number) for number in numbers]
            examples = [one.seen_from(*pose) for one, pose in zip(examples, poses, strict=True)]
        batch = collate(examples)
        losses, positions = self.module.losses(batch, [(self._seed, epoch, number) for number in numbers])
        return self._batch_loss(tracks, losses.double(), positions, batch)

    def judge(self, tracks: Sequence[int]) -> BatchLoss:
        """Mean squared error of true predictions, diffusion: sampled; the sum over tracks, in squared units."""
        numbers = [number for number in tracks if number in self._examples]
        if not numbers:
            return BatchLoss.none(self._failed(tracks))
        batch = collate([self._examples[number] for number in numbers])
        with torch.no_grad():
            positions = self.module.predict(batch)
        error = ((positions - batch.rest) / self.module.frame.units).square().sum(-1) * batch.asked
        return self._batch_loss(tracks, error.sum(1) / batch.asked.sum(1), positions, batch)

    def shown(self, track: int) -> PredictedShot | None:
        """The unobserved rest of a track."""
        one = self._examples.get(track)
        if one is None:
            return None
        with torch.no_grad():
            positions = self.module.predict(collate([one]))[0]
        return PredictedShot(self._names[track], one.times.numpy(), one.rest.numpy(), positions.double().numpy())

    def predictor(self) -> SequencePredictor:
        """The model as it is now, for use."""
        return SequencePredictor(self._architecture, self._launcher, self.module)

    def export(self, folder: Path) -> Path:
        """Write the predictor. Returns: its folder, for `SequencePredictor.load`."""
        path = folder / FOLDER
        self.predictor().replace(path)  # that of a run that was stopped while it ended
        return path

    def _batch_loss(self, tracks: Sequence[int], losses: Tensor, positions: Tensor, batch: Batch) -> BatchLoss:
        squares = float((positions - batch.rest)[batch.asked].square().sum())
        return BatchLoss(losses.sum(), len(losses), squares, int(batch.asked.sum()), self._failed(tracks))

    def _failed(self, tracks: Sequence[int]) -> tuple[tuple[str, str], ...]:
        return tuple((self._names[number], self._unusable[number]) for number in tracks if number in self._unusable)


def build_sequence(config: TrainConfig) -> Prepared:
    """The trainee of the kinds lstm and diffusion, on the same shots as a model of the dynamics would have.

    Raises: ValueError, FileNotFoundError: bad input.
    """
    data = read_training_data(config)
    launcher = LauncherSettings()
    if data.embedding is not None:
        launcher = LauncherSettings(data.embedding.labels, data.embedding.categories)
    usable = [_usable(shot) for shot in data.shots]
    trainee = SequenceTrainee(
        [track for track, _ in usable],
        [observed for _, observed in usable],
        data.train,
        architecture=SequenceArchitecture.of(cast(SequenceKind, config.kind)),
        launcher=launcher,
        seed=config.seed,
        augment=config.augmented,
    )
    return Prepared(trainee, data.train, data.validation)


def _usable(shot: TrainingShot) -> tuple[Track, int]:
    """The usable samples of a shot, and the number of observed ones."""
    keep, track = shot.usable, shot.track
    sigmas = None if track.sigmas is None else track.sigmas[keep]
    kept = replace(track, times=track.times[keep], positions=track.positions[keep], sigmas=sigmas)
    return kept, int(keep[: shot.observed].sum())


class SequenceModelKind(TraineeKind):
    """A network from observations to the rest of a track."""

    unused: ClassVar[tuple[str, ...]] = ("architecture", "model", "noise", "gradient", "options")
    augmented = True

    @classmethod
    def build(cls, config: TrainConfig) -> Prepared:
        """The model with its data, ready to train."""
        return build_sequence(config)


class Lstm(SequenceModelKind):
    """A recurrent network."""

    name = "lstm"


class Diffusion(SequenceModelKind):
    """A conditional diffusion model."""

    name = "diffusion"
