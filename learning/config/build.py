"""From a config to what the training loop takes: data, model, split; and from a trained model back to a model file."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from ballfg.dynamics import BallModel, save_model
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import build as build_model
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.trained import Trained
from ballfg.estimation import Settings, dataset_settings, dataset_surfaces
from ballfg.estimation.launcher import Launcher
from ballfg.factors.noise import ProcessNoise
from ballfg.learning.calibration.coefficients import analytic_model
from ballfg.learning.config.training import SEQUENCES, TrainConfig
from ballfg.learning.end_to_end.anchor import Anchor
from ballfg.learning.end_to_end.end_to_end import EndToEnd
from ballfg.learning.end_to_end.first_spins import begin_with_tracks
from ballfg.learning.end_to_end.learnables import Learnables, NoiseScales
from ballfg.learning.end_to_end.pretrain import pretrain
from ballfg.learning.gradient.implicit import GaussNewtonGradient, GradientMethod, ImplicitGradient, UnrolledGradient
from ballfg.learning.run.run_folder import MODEL
from ballfg.learning.sequence.build import build_sequence, export_sequence
from ballfg.learning.sequence.launcher import LauncherSettings
from ballfg.learning.sequence.trainee import SequenceTrainee
from ballfg.learning.shots import Shot, shots_of
from ballfg.learning.split import training_split
from ballfg.learning.trainee import Trainee
from ballfg.tracks import Dataset, Track, read_dataset

GRADIENTS: Mapping[str, type[GradientMethod]] = {
    "implicit": ImplicitGradient,
    "gauss-newton": GaussNewtonGradient,
    "unrolled": UnrolledGradient,
}
FIRST_SPIN = {"topspin": (0.0, 50.0, 0.0), "sidespin": (0.0, 0.0, 50.0)}
"""rad/s about (forward, across, up) per level of settings whose axis has a name; other settings start at no spin."""
FIRST_SPIN_NOISE = 60.0
"""rad/s, how well settings tell the spin before anything is learned."""


def build(config: TrainConfig) -> tuple[Trainee, Sequence[int], Sequence[int]]:
    """The model with its data, the numbers of the tracks that train, and of those that validate.

    Raises: ValueError, FileNotFoundError: for what the user can mend.
    """
    datasets = [_open(folder) for folder in config.data or ()]
    tracks = [(number, _grouped(track, dataset)) for number, dataset in enumerate(datasets) for track in dataset]
    analytic = _analytic(config, datasets)
    train, validation = training_split(tracks, config.split, config.seed)
    embedding = _embedding(config, [tracks[k] for k in train])
    settings = [_settings(config, dataset, analytic, embedding) for dataset in datasets]
    shots, kept = _shots(config, datasets, tracks, analytic, settings)
    train, validation = ([kept[k] for k in part if k in kept] for part in (train, validation))
    if not train:
        raise ValueError(f"data must hold a track to train on; none of {len(tracks)} can be used. See the notes above.")
    if embedding is not None and config.launcher.start == "tracks":
        begin_with_tracks(embedding, [shots[k] for k in train], analytic)
    if config.kind in SEQUENCES:
        launcher = LauncherSettings() if embedding is None else LauncherSettings(embedding.labels, embedding.categories)
        return build_sequence(config, shots, train, launcher), train, validation
    noise = NoiseScales(
        settings[0].process, position=config.noise.position_scale or 1.0, learned=config.loss.likelihood > 0.0
    )
    model = _model(config, analytic)
    trainee = EndToEnd(
        shots,
        Learnables(model, embedding, noise),
        config.loss,
        method=GRADIENTS[config.gradient](),
        seed=config.seed,
        augment=config.augmented,
        anchor=Anchor(model, analytic, config.seed) if config.loss.anchor > 0.0 else None,
        coefficient_step=config.optimizer.coefficient_step,
        noise_step=config.optimizer.noise_step,
    )
    return trainee, train, validation


def export(trainee: Trainee, folder: Path) -> Path:
    """Write what was trained; returns the file that `--model` of other commands takes, or a sequence model's folder."""
    if isinstance(trainee, SequenceTrainee):
        return export_sequence(trainee, folder)
    assert isinstance(trainee, EndToEnd)
    path = folder / MODEL
    save_model(trained_model(trainee), path)
    return path


def trained_model(trainee: EndToEnd) -> BallModel:
    """The model with the noise and the launcher that were learned with it."""
    learnables, settings = trainee.learnables, trainee.shots[0].settings
    noise, launcher = learnables.noise, settings.launcher
    learnables.model.trained = Trained(
        process_noise={**vars(noise.start), **noise.values()},
        position_scale=noise.position_scale(),
        launcher=learnables.embedding,
        spin_noise=_spin_noise(settings) * noise.spin_scale() if noise.learned or launcher is not None else None,
    )
    return learnables.model


def _spin_noise(settings: Settings) -> float:
    """rad/s, of what is said of first spins before anything is learned."""
    return settings.spin_label_noise if settings.launcher is None else settings.launcher.sigma


def _open(folder: str) -> Dataset:
    dataset = read_dataset(folder)
    for note in dataset.notes:
        print(f"note: {note}", file=sys.stderr)
    return dataset


def _grouped(track: Track, dataset: Dataset) -> Track:
    """The track; of a dataset without groups, which is one group, with a label that says so."""
    return track if "group" in track.labels else replace(track, labels={**track.labels, "group": dataset.info.name})


def _analytic(config: TrainConfig, datasets: Sequence[Dataset]) -> AnalyticModel:
    """The analytic model that is tuned, corrected, or where networks start."""
    radii = {dataset.info.ball.radius for dataset in datasets}
    if len(radii) > 1:
        raise ValueError(f"data must be of one kind of ball; got radii {sorted(radii)} m. Train a model for each.")
    model = analytic_model(config.model, radii.pop())
    if not model.measures_plainly:
        raise ValueError("model must have no measurement effects; got some, which training does not know. Remove them.")
    return model


def _model(config: TrainConfig, analytic: AnalyticModel) -> BallModel:
    if config.kind == "a-tune":
        return analytic
    chosen = config.architecture.model_dump(exclude_none=True, exclude={"pretrain"})
    architecture = Architecture.of(config.kind, **chosen)  # type: ignore[arg-type]
    base = analytic if architecture.residual else None
    model = build_model(architecture, radius=analytic.radius, base=base, seed=config.seed)
    if base is None and config.architecture.pretrain:
        left = pretrain(model, analytic, config.seed, config.architecture.pretrain)
        print(f"networks fitted to the analytic model: {left:.2g} m/s^2, 0.1 m/s, 10 rad/s left", flush=True)
    return model


def _embedding(config: TrainConfig, tracks: Sequence[tuple[int, Track]]) -> SpinEmbedding | None:
    """What launcher settings mean, before anything is learned."""
    labels = config.launcher.labels
    if labels is None:
        return None
    categories = categories_of(labels, tracks)
    names = SpinEmbedding(labels, categories).names
    rows = [FIRST_SPIN.get(name, (0.0, 0.0, 0.0)) for name in names]
    return SpinEmbedding(labels, categories, torch.tensor(rows, dtype=torch.float64))


def categories_of(labels: Sequence[str], tracks: Sequence[tuple[int, Track]]) -> dict[str, tuple[str, ...]]:
    """The values of those labels that are text. Raises: ValueError: if no track has a label."""
    categories: dict[str, tuple[str, ...]] = {}
    for label in labels:
        values = [track.labels.get(label) for _, track in tracks]
        if all(value is None for value in values):
            raise ValueError(f"launcher.labels must be labels of the tracks; no track has '{label}'. See labels.csv.")
        texts = sorted({value for value in values if isinstance(value, str)})
        if texts:
            categories[label] = tuple(texts)
    return categories


def _settings(
    config: TrainConfig, dataset: Dataset, analytic: AnalyticModel, embedding: SpinEmbedding | None
) -> Settings:
    """The estimator's settings for a dataset, with the config's noise; the model is taken to be exact."""
    given = config.noise.model_dump(exclude_none=True, exclude={"position_scale"})
    spin = given.pop("spin_label", None)
    settings = dataset_settings(dataset, analytic)
    process: ProcessNoise = replace(settings.process, **given)
    launcher = None
    if embedding is not None:
        launcher = Launcher(embedding, spin or FIRST_SPIN_NOISE, {"group": dataset.info.name})
    return replace(
        settings,
        process=process,
        coefficients={},
        launcher=launcher,
        spin_label_noise=spin or settings.spin_label_noise,
    )


def _shots(
    config: TrainConfig,
    datasets: Sequence[Dataset],
    tracks: Sequence[tuple[int, Track]],
    analytic: AnalyticModel,
    settings: Sequence[Settings],
) -> tuple[list[Shot], dict[int, int]]:
    """Shots, and the number of each track's shot; what is left out is said on stderr."""
    shots: list[Shot] = []
    kept: dict[int, int] = {}
    reasons: Counter[str] = Counter()
    for number, dataset in enumerate(datasets):
        mine = [k for k, (owner, _) in enumerate(tracks) if owner == number]
        made = shots_of(
            (tracks[k][1] for k in mine),
            analytic,
            dataset_surfaces(dataset),
            settings[number],
            samples=config.observe.samples,
            seconds=config.observe.seconds,
        )
        for k, (_, shot) in zip(mine, made, strict=True):
            if isinstance(shot, str):
                reasons[f"{dataset.info.name}: {shot}"] += 1
            else:
                kept[k] = len(shots)
                shots.append(shot)
    for reason, count in reasons.items():
        print(f"note: {count} tracks of {reason}", file=sys.stderr)
    return shots, kept
