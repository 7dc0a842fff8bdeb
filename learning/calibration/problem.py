"""Holds what a calibration is given, its steps in plain numbers, the model and settings of a step, and judges them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Self

import numpy as np
from pydantic import Field

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Estimator, Settings, dataset_settings, dataset_surfaces
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.noise.parameters import with_noise
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.coefficients import ONE_VIEW, USUAL, Chosen, choose, with_values
from ballfg.learning.calibration.correction import Correction, doubt_sigmas, set_doubts
from ballfg.learning.calibration.groups import Groups, GroupSpin
from ballfg.learning.calibration.population import Evidence
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import AUTO
from ballfg.learning.evaluation import Plain, TrackScore, judge_track
from ballfg.learning.split import Split, split_tracks, tracks_of
from ballfg.progress import Watch, unwatched
from ballfg.tracks import Dataset, Track
from ballfg.tracks.noise import TrackNoise


@dataclass(frozen=True)
class Problem:
    """A calibration, checked and ready to start; made by `pose`. The estimator's settings are those of `predict`."""

    dataset: Dataset | SightedDataset
    config: CalibrationConfig
    model: AnalyticModel
    chosen: Chosen
    surfaces: Surfaces
    settings: Settings
    split: Split
    jobs: int
    groups: Groups | None = None
    correction: Correction | None = None
    shown: TrackNoise | None = None  # The noise that the fitted tracks are linearised with; None: the settings'

    @property
    def horizon(self) -> float:
        """Length of the judged forecasts, s; infinite: to the end of a track."""
        return np.inf if self.config.horizon is None else self.config.horizon

    @property
    def linearising(self) -> Settings:
        """The settings with that noise; priors of coefficients and the noise of spin labels stay.

        A lift that is wrong looks like wrong labels: with wide ones, lift and spin cannot be told apart.
        """
        if self.shown is None:
            return self.settings
        return with_noise(self.settings, replace(self.shown, coefficients={}, spin_label=None))


class TrackFit(Plain):
    """Posterior of one track's p coefficients, the model's prior included."""

    name: str
    values: tuple[float, ...]
    sigmas: tuple[float, ...]


class Step(Plain):
    """One step in plain numbers, which a checkpoint keeps to the last bit. Step 0 only judges the first model."""

    number: int
    mean: tuple[float, ...]  # (p,) the population's mean: the coefficients of the next model
    sigma: tuple[float, ...] = ()  # (p,) standard errors of the mean
    spread: tuple[float, ...] = ()  # (p,) standard deviations between tracks
    next_track: tuple[float, ...] = ()  # (p,) standard deviations of a new track's coefficients about the mean
    spins: tuple[GroupSpin, ...] = ()  # The spins of each group, in the order of `Groups.names`; none without groups
    by_group: dict[str, tuple[float, ...]] = Field(default_factory=dict)
    """Means by group, in the same order, of the coefficients that differ between groups."""
    doubts: tuple[tuple[float, ...], ...] = ()
    """Directions of the uncertainty of a correction's weights; none without a correction."""
    moved: float | None = None  # Largest move of a mean in this step, in standard errors
    fits: tuple[TrackFit, ...] = ()  # Posteriors of the tracks that were used
    skipped: tuple[tuple[str, str], ...] = ()  # Name and reason of each track that was not used
    predicting: float | None = None
    """Gain in the log score of left-out tracks by means that predict best; None: the means are the most probable."""
    scores: tuple[TrackScore | None, ...] = ()
    """Scores of the judging tracks with the mean of this step; None where a track could not be judged."""


@dataclass(frozen=True)
class Linear:
    """Fitted tracks, linearised: posteriors, likelihoods without the prior, names and reasons of skipped tracks."""

    fits: tuple[TrackFit, ...]
    evidences: tuple[Evidence, ...]
    skipped: tuple[tuple[str, str], ...]

    def without(self, names: Sequence[str]) -> Self:
        """Without some tracks."""
        kept = [k for k, fit in enumerate(self.fits) if fit.name not in names]
        return replace(self, fits=tuple(self.fits[k] for k in kept), evidences=tuple(self.evidences[k] for k in kept))


def pose(dataset: Dataset | SightedDataset, model: AnalyticModel, config: CalibrationConfig, jobs: int = 1) -> Problem:
    """Check a calibration against its data before anything starts; the model has the ball's radius.

    Raises: ValueError: coefficients that the model does not have or the data cannot determine, too few tracks.
    """
    if dataset.one_view and (config.kind == AUTO or config.groups is not None):
        raise ValueError(
            "groups and kind: auto need positions, or two cameras; one camera's spins hold errors of its depth. Write "
            "kind: calibrate without groups."
        )
    chosen = choose(model, config.coefficients, ONE_VIEW if dataset.one_view else USUAL)
    split = split_tracks(dataset, config.split, config.seed, needs_spin=chosen.needs_spin)
    surfaces, settings = dataset_surfaces(dataset), dataset_settings(dataset, model)
    groups = None if config.groups is None else Groups.of(dataset, config.groups, split.fit)
    return Problem(dataset, config, model, chosen, surfaces, settings, split, jobs, groups)


def population_settings(problem: Problem, step: Step) -> Settings:
    """Settings with the population's distribution of a new track as the prior of each calibrated number."""
    learned = {name: step.next_track[k] for k, name in problem.chosen.listed}
    learned |= {} if problem.correction is None else doubt_sigmas(problem.model)
    settings = replace(problem.settings, coefficients={**problem.settings.coefficients, **learned})
    groups = problem.groups
    return settings if groups is None else groups.settings(settings, groups.population(step.spins))


def population_model(problem: Problem, step: Step) -> AnalyticModel:
    """The model with the means of a step, and each group's own where coefficients differ between groups."""
    model = with_values(problem.model, problem.chosen.names, np.array(step.mean))
    if problem.groups is not None:
        model.variations = {**model.variations, **problem.groups.variations(step.by_group)}
    set_doubts(model, step.doubts)
    return model


def plain(values: Array) -> tuple[float, ...]:
    """Numbers (n,) as a step keeps them."""
    return tuple(values.tolist())


def score(
    problem: Problem, model: AnalyticModel, settings: Settings, watch: Watch = unwatched
) -> tuple[TrackScore | None, ...]:
    """Scores of the judging tracks, in order, by a model with its settings."""
    shares = (problem.config.observed_share,)
    return judged(problem, [(model, settings)], problem.split.judge, shares, problem.horizon, watch)


def judged(
    problem: Problem,
    made: Sequence[tuple[AnalyticModel, Settings]],
    names: tuple[str, ...],
    shares: Sequence[float],
    horizon: float,
    watch: Watch,
) -> tuple[TrackScore | None, ...]:
    """Scores of the forecasts of some tracks from some shares of each, track after track.

    Args: made: model and settings of each fold of the tracks; one of all tracks is the fold of all.
    """
    smoothers = [make_estimator("smoother", model, problem.surfaces, settings) for model, settings in made]
    of_track = {name: smoothers[k % len(smoothers)] for k, name in enumerate(names)}
    forecasts, tracks = partial(_forecasts, of_track, shares, horizon), tracks_of(problem.dataset, names)
    scores = map_tracks(forecasts, tracks, len(names), problem.jobs)
    return tuple(chain.from_iterable(watch(scores, len(names), "tracks judged")))


def _forecasts(
    smoothers: Mapping[str, Estimator], shares: Sequence[float], horizon: float, track: Track
) -> list[TrackScore | None]:
    """Scores of one track's forecasts from each share of it, by its own smoother."""
    return [judge_track(smoothers[track.name], track, share, horizon) for share in shares]
