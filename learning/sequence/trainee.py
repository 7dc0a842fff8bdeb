"""Adapts a sequence model with its tracks to the training loop."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, cast

import torch
from torch import Tensor

from ballfg.learning.augment import augmentation
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.sequence.data import Batch, Example, LauncherSettings, collate, example
from ballfg.learning.sequence.model import SequenceModel
from ballfg.learning.sequence.predictor import DEFAULT_WIDTH, SequenceArchitecture, SequenceKind, SequencePredictor
from ballfg.learning.trainee import BatchLoss, PredictedShot, Prepared, Trainee, TraineeKind
from ballfg.learning.training_data import read_training_data
from ballfg.tracks import Track

FOLDER = "model"  # Folder of the predictor, in that of a training


class SequenceTrainee(Trainee):
    """Trains an LSTM or diffusion model to predict the unobserved rest of tracks.

    A track that cannot be used - too short, launcher settings missing - counts as failed in each batch.

    Args:
        observed: number of observed samples of each track.
        train: numbers of the training tracks, from which the model takes its scales.
        seed: of initial weights, augmentation and diffusion noise, >= 0.
        augment: True to rotate and shift training tracks.
    Raises: ValueError: if no track of the training part can be used.
    """

    module: SequenceModel
    read_by = "SequencePredictor.load of ballfg.learning.sequence.predictor"

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
        self._seed, self._augment = seed, augment

    def loss(self, tracks: Sequence[int], epoch: int) -> BatchLoss:
        """Sum of the tracks' losses, in squared units of the frame; lstm: squared error, diffusion: denoising.

        `squared_error` is that of the positions predicted in training; diffusion: of the denoised paths.
        """
        examples = self._usable(tracks)
        if self._augment:
            poses = {number: augmentation(self._seed, epoch, number) for number in examples}
            examples = {number: one.seen_from(*poses[number]) for number, one in examples.items()}
        draws = [(self._seed, epoch, number) for number in examples]
        return self._batch_loss(tracks, examples, lambda batch: self.module.losses(batch, draws))

    def judge(self, tracks: Sequence[int]) -> BatchLoss:
        """Mean squared error of true predictions, diffusion: sampled; the sum over tracks, in squared units."""

        def judged(batch: Batch) -> tuple[Tensor, Tensor]:
            positions = self.module.predict(batch)
            return self.module.errors(positions, batch), positions

        with torch.no_grad():
            return self._batch_loss(tracks, self._usable(tracks), judged)

    def _usable(self, tracks: Sequence[int]) -> dict[int, Example]:
        return {number: self._examples[number] for number in tracks if number in self._examples}

    def _batch_loss(
        self, tracks: Sequence[int], examples: dict[int, Example], losses: Callable[[Batch], tuple[Tensor, Tensor]]
    ) -> BatchLoss:
        """The sums over tracks; losses: (b,) of a batch, and the positions (b, m, 3) m predicted in it."""
        failed = tuple((self._names[n], self._unusable[n]) for n in tracks if n in self._unusable)
        if not examples:
            return BatchLoss.none(failed)
        batch = collate(list(examples.values()))
        each, positions = losses(batch)
        squares = float((positions - batch.rest)[batch.asked].square().sum())
        return BatchLoss(each.double().sum(), len(each), squares, int(batch.asked.sum()), failed)

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
        self.predictor().save(path)  # that of a run that was stopped while it ended
        return path


class SequenceModelKind(TraineeKind):
    """A network from observations to the rest of a track, on the same shots as a model of the dynamics would have."""

    unused: ClassVar[tuple[str, ...]] = (
        *("architecture", "model", "noise", "gradient", "loss", "options"),
        *("launcher.start", "optimizer.noise_step", "optimizer.coefficient_step"),
    )
    augmented = True

    @classmethod
    def build(cls, config: TrainConfig) -> Prepared:
        """The model with its data, ready to train. Raises: ValueError, FileNotFoundError: bad input."""
        data, kept, observed = read_training_data(config), list[Track](), list[int]()
        kind = cast(SequenceKind, config.kind)
        for shot in data.shots:
            usable, track = shot.usable, shot.track
            sigmas = None if track.sigmas is None else track.sigmas[usable]
            kept.append(replace(track, times=track.times[usable], positions=track.positions[usable], sigmas=sigmas))
            observed.append(int(usable[: shot.observed].sum()))
        known = data.embedding
        trainee = SequenceTrainee(
            kept,
            observed,
            data.train,
            architecture=SequenceArchitecture(kind, DEFAULT_WIDTH[kind]),
            launcher=LauncherSettings() if known is None else LauncherSettings(known.labels, known.categories),
            seed=config.seed,
            augment=config.augmented,
        )
        return Prepared(trainee, data.train, data.validation)


class Lstm(SequenceModelKind):
    """A recurrent network."""

    name = "lstm"


class Diffusion(SequenceModelKind):
    """A conditional diffusion model."""

    name = "diffusion"
