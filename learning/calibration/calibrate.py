"""Calibrates coefficients on a population of tracks, judged by the prediction of other tracks.

Each step estimates the fitted tracks with the smoother, removes the priors from their posteriors of the coefficients,
finds the population's mean and spread, and puts the mean into the model. It ends when the mean no longer moves.
docs/train.md.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Final, Self

import numpy as np
from pydantic import Field

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import (
    Estimate,
    Estimator,
    Settings,
    Smoother,
    dataset_settings,
    dataset_surfaces,
    estimate_noise,
)
from ballfg.estimation.batch import estimate_tracks, map_tracks
from ballfg.estimation.configure import usual_settings
from ballfg.estimation.noise.estimate import NoiseEstimate, spread_over
from ballfg.estimation.noise.parameters import with_medians, with_noise
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.estimation.registry import make_estimator
from ballfg.factors.loss import Loss
from ballfg.learning.calibration.coefficients import ONE_VIEW, USUAL, Chosen, choose, with_values
from ballfg.learning.calibration.correction import Correction, doubt_sigmas, set_doubts, with_correction, with_weights
from ballfg.learning.calibration.groups import Groups, GroupSpin
from ballfg.learning.calibration.population import Evidence, agreeing, evidence, fit_population
from ballfg.learning.calibration.volume import estimate_with_slopes
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import AUTO
from ballfg.learning.evaluation import JUDGED, Plain, TrackScore, judge_track
from ballfg.learning.split import Split, split_tracks, tracks_of
from ballfg.progress import Watch, unwatched
from ballfg.tracks import Dataset, Track
from ballfg.tracks.noise import TrackNoise

ROUGHLY: Final = 0.3
"""Tolerance of a correction at least: its weights move slowly along directions that hardly change a prediction."""
FIRST: Final = 0.75  # s, the part of each track that teaches a correction: later on contacts say more than the air does


class TooManyFailures(ValueError):  # noqa: N818 - the name is the statement
    """More estimates failed than the config allows."""


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


def with_shown_noise(problem: Problem, watch: Watch = unwatched) -> Problem:
    """The problem with the noise that the fitted tracks show about its first model."""
    noise = fitted_noise(problem, problem.model, problem.settings, watch, errors=False)
    return replace(problem, shown=None if noise is None else noise.noise)


def pose_correction(
    problem: Problem, last: Step, watch: Watch = unwatched, noise: NoiseEstimate | None = None
) -> Problem:
    """The problem of a correction of drag and lift on top of a calibration with groups.

    It begins from a first step with the noise that the tracks show about the calibrated model.

    Args: noise: that one, if it is known already.
    Raises: ValueError: as `with_correction`. TooManyFailures: as `calibrate`.
    """
    model, settings, names = population_model(problem, last), population_settings(problem, last), problem.split.fit
    noise = noise or fitted_noise(problem, model, settings, watch, errors=False)
    settings = settings if noise is None else noise.settings
    # a wrong lift contradicts right labels: how fast the balls spin, and so what the functions span, is theirs to say
    settings = replace(settings, spin_label_noise=problem.settings.spin_label_noise, label_loss=Loss("squared"))
    smoother = make_estimator("smoother", model, problem.surfaces, settings)
    estimates = estimate_tracks(smoother, tracks_of(problem.dataset, names), len(names), problem.jobs)
    labelled = problem.groups is not None and bool(problem.groups.labelled)
    corrected, terms = with_correction(model, watch(estimates, len(names), "tracks estimated"), labelled=labelled)
    corrected.variations = dict(problem.model.variations)  # those of groups are found anew
    chosen = with_weights(corrected, problem.chosen, labelled=labelled)
    mean = np.concatenate((last.mean, np.zeros(len(chosen.shared))))
    config = problem.config.model_copy(update={"tolerance": max(problem.config.tolerance, ROUGHLY)})
    begun = Correction(mean, last.spins, terms)
    posed = replace(problem, model=corrected, chosen=chosen, config=config, correction=begun)
    if noise is None:
        return posed
    # what the calibrated model lacks looks like noise: the correction has the noise about its first step
    posed, step = replace(posed, shown=noise.noise), Step(number=0, mean=_plain(mean))
    step = advanced(posed, step, linearised(posed, step, watch))
    posed = replace(posed, correction=replace(begun, mean=np.array(step.mean), spins=step.spins))
    shown = fitted_noise(posed, population_model(posed, step), population_settings(posed, step), watch, errors=False)
    return posed if shown is None else replace(posed, shown=shown.noise)


def calibrate(problem: Problem, done: Iterable[Step] = (), *, watch: Watch = unwatched) -> Iterator[Step]:
    """The remaining steps, each as soon as it is finished; none if the calibration has ended.

    Args: done: steps of an earlier run of the same problem, which continues to the same numbers.
    Raises: TooManyFailures: more estimates of fitted tracks failed than the config allows.
    """
    steps = list(done)
    if not steps:
        steps.append(first_step(problem, watch))
        yield steps[-1]
    while not has_ended(problem.config, steps[-1]):
        found = advanced(problem, steps[-1], linearised(problem, steps[-1], watch))
        steps.append(with_scores(problem, found, watch) if has_ended(problem.config, found) else found)
        yield steps[-1]


def first_step(problem: Problem, watch: Watch = unwatched) -> Step:
    """Step 0, where a calibration begins."""
    start = problem.chosen.start if problem.correction is None else problem.correction.mean
    return with_scores(problem, Step(number=0, mean=_plain(start)), watch)


def with_scores(problem: Problem, step: Step, watch: Watch = unwatched) -> Step:
    """A step with the scores of the judging tracks."""
    model = with_values(problem.model, problem.chosen.names, np.array(step.mean))
    return step.model_copy(update={"scores": score(problem, model, problem.settings, watch)})


def has_converged(config: CalibrationConfig, step: Step) -> bool:
    """True if the mean has stopped moving."""
    return step.moved is not None and step.moved <= config.tolerance


def has_ended(config: CalibrationConfig, step: Step) -> bool:
    """True if a step is the last one."""
    return has_converged(config, step) or step.number >= config.max_iterations


def score(
    problem: Problem, model: AnalyticModel, settings: Settings, watch: Watch = unwatched
) -> tuple[TrackScore | None, ...]:
    """Scores of the judging tracks, in order, by a model with its settings."""
    config = problem.config
    horizon = np.inf if config.horizon is None else config.horizon
    return judged(problem, [(model, settings)], problem.split.judge, (config.observed_share,), horizon, watch)


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


def fitted_noise(
    problem: Problem, model: AnalyticModel, settings: Settings, watch: Watch = unwatched, *, errors: bool = True
) -> NoiseEstimate | None:
    """The noise of the fitted tracks about the calibrated model; None if undetermined.

    Stated noise may come from the same tracks, and is not its prior; it counts where these tracks say nothing.

    Args: model: with the calibrated coefficients.  settings: with the population as the prior of each coefficient.
        errors: True to compute error bars, which take several times as long.
    """
    if not model.measures_plainly or problem.dataset.rough:
        return None
    names = problem.split.fit
    tracks = spread_over(tracks_of(problem.dataset, names), len(names))
    known = problem.dataset.info.position_noise is not None
    found = estimate_noise(
        model,
        problem.surfaces,
        with_medians(settings, usual_settings(problem.dataset, problem.model), position_known=known),
        tracks,
        position_known=known,
        errors=errors,
        watch=watch,
        jobs=problem.jobs,
    )
    if found is None:
        return None
    found = replace(found, settings=with_noise(settings, found.noise))
    return found if problem.correction is None else _with_doubts(found, doubt_sigmas(problem.model))


def _with_doubts(found: NoiseEstimate, doubts: dict[str, float]) -> NoiseEstimate:
    """The noise with doubts as wide as their posterior: tracks that taught the weights show less of them."""
    spreads = {name: sigma for name, sigma in found.noise.coefficients.items() if name not in doubts}
    settings = replace(found.settings, coefficients={**found.settings.coefficients, **doubts})
    return replace(found, noise=replace(found.noise, coefficients=spreads), settings=settings)


def advanced(problem: Problem, last: Step, linear: Linear) -> Step:
    """The population of tracks that are linearised about the last step."""
    chosen, groups, about = problem.chosen, problem.groups, np.array(last.mean)
    spins = _spins(problem, last)
    fits, evidences = linear.fits, linear.evidences
    size, before = len(about), np.concatenate((about, *(spin.mean for spin in spins)))
    next_track: Array | None = None
    by_group: dict[str, tuple[float, ...]] = {}
    found: tuple[GroupSpin, ...] = ()
    doubts: tuple[tuple[float, ...], ...] = ()
    if groups is None:
        alike = np.arange(size) if problem.dataset.one_view else None  # one view does not show a spread
        fit = partial(fit_population, start=chosen.start, sigma=chosen.sigma, low=chosen.low, high=chosen.high)
        population = fit(evidences, alike=alike)
        if alike is not None:
            population = fit(agreeing(evidences, population.mean), alike=alike)
    else:
        population, by_group, found, next_track = groups.fit(evidences, [fit.name for fit in fits], chosen)
        if problem.correction is not None:
            doubts = problem.correction.directions(chosen, population.mean[:size], population.covariance[:size, :size])
    return Step(
        number=last.number + 1,
        mean=_plain(population.mean[:size]),
        sigma=_plain(population.sigma[:size]),
        spread=_plain(population.spread[:size]),
        next_track=_plain(population.next_track[:size] if next_track is None else next_track),
        spins=found,
        doubts=doubts,
        by_group=by_group,
        moved=float(np.abs((population.mean - before) / population.sigma).max()),
        fits=fits,
        skipped=linear.skipped,
    )


def _spins(problem: Problem, last: Step) -> tuple[GroupSpin, ...]:
    """Of each group, as the last step has them, or where the calibration begins."""
    if problem.groups is None:
        return ()
    return last.spins or (problem.groups.start if problem.correction is None else problem.correction.spins)


def linearised(problem: Problem, last: Step, watch: Watch = unwatched) -> Linear:
    """The fitted tracks, linearised about the last step.

    Coefficients that vary from track to track stay free in each track, calibrated or not.

    Raises: TooManyFailures: as `calibrate`.
    """
    chosen, names, groups = problem.chosen, problem.split.fit, problem.groups
    about, spins = np.array(last.mean), _spins(problem, last)
    settings = problem.linearising
    priors = {**settings.coefficients, **dict(zip(chosen.names, chosen.sigma.tolist(), strict=True))}
    settings = replace(settings, coefficients=priors)
    model = with_values(problem.model, chosen.names, about)
    estimator = Smoother(model, problem.surfaces, settings if groups is None else groups.wide(settings, spins))
    tracks = tracks_of(problem.dataset, names)
    if problem.correction is not None:
        tracks = (track.opening(FIRST) for track in tracks)
    estimates: Iterator[tuple[Estimate, Array | None]]
    if problem.dataset.one_view:
        estimates = map_tracks(partial(estimate_with_slopes, estimator, chosen.names), tracks, len(names), problem.jobs)
    else:
        estimates = ((one, None) for one in estimate_tracks(estimator, tracks, len(names), problem.jobs))
    fits: list[TrackFit] = []
    evidences: list[Evidence] = []
    skipped: list[tuple[str, str]] = []
    for estimate, slopes in watch(estimates, len(names), "tracks fitted"):
        try:
            fit, found = _read(estimate, chosen, about)
            found = found if slopes is None else replace(found, vector=found.vector - slopes)
            if groups is not None:
                found = groups.evidence(estimate, chosen, about, spins, settings.spin_prior)
        except ValueError as error:
            skipped.append((estimate.name, str(error)))
            limit = problem.config.failure_limit
            if len(skipped) > limit * len(names):
                raise TooManyFailures(
                    f"more than {100 * limit:g} % of the {len(names)} fitted tracks failed, the last one "
                    f"'{estimate.name}': {error}. Raise failure_limit to go on without them."
                ) from None
        else:
            fits.append(fit)
            evidences.append(found)
    return Linear(tuple(fits), tuple(evidences), tuple(skipped))


def _read(estimate: Estimate, chosen: Chosen, about: Array) -> tuple[TrackFit, Evidence]:
    """Posterior and likelihood of the chosen coefficients in one estimate. Raises: ValueError: if it failed."""
    if estimate.status not in JUDGED:
        raise ValueError(estimate.status.value)
    columns = [estimate.coefficient_names.index(name) for name in chosen.names]
    mean = estimate.coefficients[columns]
    covariance = estimate.coefficient_covariance[np.ix_(columns, columns)]
    found = evidence(mean, covariance, about, chosen.sigma)
    return TrackFit(name=estimate.name, values=_plain(mean), sigmas=_plain(np.sqrt(np.diag(covariance)))), found


def _plain(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
