"""Reads the data of a training from a config: datasets, split, tracks cut into shots, settings of the estimator."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.checks import shown
from ballfg.dynamics import AnalyticModel, load_model, nominal_model
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.nominal import inertia_factor
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Settings, Smoother, dataset_settings, dataset_surfaces, read_sighted
from ballfg.estimation.configure import table_note
from ballfg.estimation.flights.dataset import in_flight
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.estimation.reading import has_positions, with_readings
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.split import training_split
from ballfg.progress import print_doubts, print_notes
from ballfg.tracks import Ball, Dataset, Track, read_dataset

LEAST_OBSERVED = 5  # Samples that an estimate needs
LEAST_PREDICTED = 3  # Samples that a prediction is judged on
D = TypeVar("D", Dataset, SightedDataset)
FIRST_SPIN = {"topspin": (0.0, 50.0, 0.0), "sidespin": (0.0, 0.0, 50.0)}
"""rad/s about (forward, across, up) per level of the settings with a known axis; other settings start at no spin."""
FIRST_SPIN_NOISE = 60.0  # rad/s, standard deviation of the spin given the settings, before anything is learned


@dataclass(frozen=True)
class TrainingShot:
    """One track, cut into an observed part and a part to predict."""

    track: Track  # the undisturbed part of the flight, up to the first hit
    observed: int  # number of samples that the estimate sees; they come first
    usable: NDArray[np.bool_]  # (n,) bool, samples that measure the ball
    segmentation: Segmentation  # events of the observed part
    settings: Settings  # of the estimator, before anything is learned
    surfaces: Surfaces
    room: str = ""  # name of the dataset

    @property
    def name(self) -> str:
        """The track's name."""
        return self.track.name

    @property
    def seen(self) -> Track:
        """The observed part."""
        return part(self.track, self.observed)


@dataclass(frozen=True)
class TrainingData:
    """The data of a training.

    Attributes:
        train, validation: numbers of the shots that train and that validate.
        analytic: the analytic model that is tuned, corrected, or where networks start.
        embedding: the spin that the launcher's settings mean; None without settings.
    """

    shots: Sequence[TrainingShot]
    train: Sequence[int]
    validation: Sequence[int]
    analytic: AnalyticModel
    embedding: SpinEmbedding | None


def read_training_data(config: TrainConfig) -> TrainingData:
    """Read the datasets of a config and cut their tracks into shots. Notes on them go to stderr.

    Raises: ValueError, FileNotFoundError: bad input, for instance no track that can be used.
    """
    datasets = [open_dataset(folder) for folder in config.data or ()]
    tracks = [
        (number, replace(track, labels={"group": dataset.info.name, **track.labels}))  # without groups it is one group
        for number, dataset in enumerate(datasets)
        for track in dataset
    ]
    radii = {dataset.info.ball.radius for dataset in datasets}
    if len(radii) > 1:
        raise ValueError(f"data must be of one kind of ball; got radii {sorted(radii)} m. Train a model for each.")
    check_apart(datasets, tracks)
    alike = [name for name, count in Counter(dataset.info.name for dataset in datasets).items() if count > 1]
    print_notes(f"{shown(name)} names several datasets: they count as one room and group" for name in alike)
    analytic = analytic_model(config.model, datasets[0].info.ball)
    if not analytic.measures_plainly:
        raise ValueError("model must have no measurement effects; got some, which training does not know. Remove them.")
    train, validation = training_split(tracks, config.split, config.seed)
    embedding = _embedding(config, [tracks[k][1] for k in train])
    settings = [_settings(config, dataset, analytic, embedding) for dataset in datasets]
    shots, kept = _shots(config, datasets, tracks, analytic, settings)
    train, validation = ([kept[k] for k in part if k in kept] for part in (train, validation))
    if not train:
        raise ValueError(f"data must hold a track to train on; none of {len(tracks)} can be used. See the notes above.")
    return TrainingData(shots, train, validation, analytic, embedding)


def check_apart(datasets: Sequence[Dataset | SightedDataset], tracks: Iterable[tuple[int, Track]]) -> None:
    """Refuses datasets that share a track, which would train and validate, whatever their names and folders.

    Args: tracks: with the number of their dataset.
    Raises: ValueError: naming the first such track.
    """
    first: dict[bytes, tuple[int, str]] = {}
    for number, track in tracks:
        content = hashlib.sha256(track.times.tobytes() + track.positions.tobytes()).digest()
        owner, name = first.setdefault(content, (number, track.name))
        if owner != number:
            raise ValueError(
                f"data must hold each track once; got track {shown(track.name)} of {datasets[number].path} also as "
                f"{shown(name)} of {datasets[owner].path}. Give each recording once."
            )


def open_dataset(folder: str, anyway: bool | None = None) -> Dataset:
    """The flights of a folder with all readings beside its positions; notes on repairs and on the table go to stderr.

    Args: anyway: True for tracks of which less than half falls like a ball; None: the config has no such key.
    Raises: ValueError, FileNotFoundError: as in reading; ValueError: such tracks otherwise.
    """
    dataset = noted(with_readings(read_dataset(folder)))
    found = in_flight(dataset)
    print_doubts(found.lines)
    found.check(folder, bool(anyway), "" if anyway is None else ", or set anyway: true")
    return found.dataset


def open_source(folder: str, source: str | None, anyway: bool = False) -> Dataset | SightedDataset:
    """As `open_dataset`, or the sightings of its cameras.

    Args: source: `positions` or `detections`; None: positions, if the folder has a table of them.  anyway: as there.
    Raises: ValueError, FileNotFoundError: as in reading.
    """
    positions = has_positions(folder) if source is None else source == "positions"
    return open_dataset(folder, anyway) if positions else noted(read_sighted(folder))


def noted(dataset: D) -> D:
    """The dataset, after its doubts and, on stderr, its notes."""
    print_doubts(dataset.info.doubts)
    print_notes([*dataset.notes, *filter(None, [table_note(dataset)])])
    return dataset


def analytic_model(path: str | None, ball: Ball) -> AnalyticModel:
    """The analytic model of a file, or the nominal one of the ball for None.

    Raises: ValueError: if the file's model has a learned part, or coefficients that differ between tracks.
    """
    if path is None:
        return nominal_model(ball)
    model = load_model(path, radius=ball.radius, inertia_factor=inertia_factor(ball))
    if not isinstance(model, AnalyticModel):
        raise ValueError(f"model must be analytic; {path} has a learned part. Give its base, or leave it out.")
    if model.variations:
        raise ValueError(f"model must be the same for all tracks; {path} has variations. Leave that section out.")
    return model


def categories_of(labels: Sequence[str], tracks: Sequence[Track]) -> dict[str, tuple[str, ...]]:
    """The values of those labels that are text. Raises: ValueError: if no track has a label."""
    categories: dict[str, tuple[str, ...]] = {}
    for label in labels:
        values = [track.labels.get(label) for track in tracks]
        if all(value is None for value in values):
            raise ValueError(f"launcher.labels must be labels of the tracks; no track has '{label}'. See labels.csv.")
        texts = sorted({value for value in values if isinstance(value, str)})
        if texts:
            categories[label] = tuple(texts)
    return categories


def _embedding(config: TrainConfig, tracks: Sequence[Track]) -> SpinEmbedding | None:
    """The meaning of the launcher's settings before anything is learned."""
    if config.launcher.labels is None:
        return None
    embedding = SpinEmbedding(config.launcher.labels, categories_of(config.launcher.labels, tracks))
    rows = [FIRST_SPIN.get(name, (0.0, 0.0, 0.0)) for name in embedding.names]
    return SpinEmbedding(embedding.labels, embedding.categories, torch.tensor(rows, dtype=torch.float64))


def _settings(
    config: TrainConfig, dataset: Dataset, analytic: AnalyticModel, embedding: SpinEmbedding | None
) -> Settings:
    """The estimator's settings for a dataset, with the noise of the config; the model counts as exact."""
    given = config.noise.model_dump(exclude_none=True, exclude={"position_scale"})
    spin = given.pop("spin_label", None)
    settings, launcher = dataset_settings(dataset, analytic), None
    if embedding is not None:
        launcher = Launcher(embedding, spin or FIRST_SPIN_NOISE, {"group": dataset.info.name})
    return replace(
        settings,
        process=replace(settings.process, **given),
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
) -> tuple[list[TrainingShot], dict[int, int]]:
    """Shots, and the number of each track's shot; reasons for tracks without one go to stderr."""
    shots: list[TrainingShot] = []
    kept: dict[int, int] = {}
    reasons: Counter[str] = Counter()
    for number, dataset in enumerate(datasets):
        mine = [k for k, (owner, _) in enumerate(tracks) if owner == number]
        own, observed = (tracks[k][1] for k in mine), config.observe.model_dump()
        made = shots_of(own, analytic, dataset_surfaces(dataset), settings[number], **observed)
        for k, (_, shot) in zip(mine, made, strict=True):
            if isinstance(shot, str):
                reasons[f"{dataset.info.name}: {shot}"] += 1
            else:
                kept[k] = len(shots)
                shots.append(replace(shot, room=dataset.info.name))
    print_notes(f"{count} tracks of {reason}" for reason, count in reasons.items())
    return shots, kept


def part(track: Track, count: int) -> Track:
    """The first samples of a track."""
    return track.until(float(track.times[count - 1]))


def shots_of(
    tracks: Iterable[Track],
    model: BallModel,
    surfaces: Surfaces,
    settings: Settings,
    *,
    samples: int | None,
    seconds: float | None,
) -> Iterator[tuple[Track, TrainingShot | str]]:
    """Each track with its shot, or the reason why it gives none. Observed are so many samples, or seconds.

    The model finds the events; an analytic one will do.
    """
    smoother = Smoother(model, surfaces, settings)
    for given in tracks:
        track = given.since_first()
        whole = smoother.segment(track)
        end = int(whole.hits[0]) + 1 if len(whole.hits) else len(track)
        track, usable = part(track, end), whole.usable[:end]
        observed = samples if seconds is None else len(track.opening(seconds))
        assert observed is not None
        if observed < LEAST_OBSERVED or usable[:observed].sum() < LEAST_OBSERVED:
            yield given, f"fewer than {LEAST_OBSERVED} usable samples are observed"
        elif usable[observed:].sum() < LEAST_PREDICTED:
            least = f"fewer than {LEAST_PREDICTED} usable samples"
            yield given, f"{least} follow the observed part before the ball is hit"
        else:
            events = smoother.segment(part(track, observed))
            yield given, TrainingShot(track, observed, usable, events, smoother.settings, smoother.surfaces)
