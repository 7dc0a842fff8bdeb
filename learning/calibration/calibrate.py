"""Calibrates coefficients on a population of tracks, judged by the prediction of other tracks.

Each step estimates the fitted tracks with the smoother, removes the priors from their posteriors of the coefficients,
finds the population's mean and spread, and puts the mean into the model. It ends when the mean no longer moves.
docs/train.md.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import (
    Estimate,
    Settings,
    Smoother,
    estimate_noise,
)
from ballfg.estimation.batch import estimate_tracks, map_tracks
from ballfg.estimation.configure import usual_settings
from ballfg.estimation.measurement.invert_measurement import InvertMeasurement
from ballfg.estimation.noise.estimate import NoiseEstimate, spread_over
from ballfg.estimation.noise.parameters import with_medians, with_noise
from ballfg.estimation.registry import make_estimator
from ballfg.factors.loss import Loss
from ballfg.learning.calibration.coefficients import Chosen, with_values
from ballfg.learning.calibration.correction import Correction, doubt_sigmas, with_correction, with_weights
from ballfg.learning.calibration.groups import GroupSpin
from ballfg.learning.calibration.population import Evidence, agreeing, evidence, fit_population
from ballfg.learning.calibration.problem import (
    Linear,
    Problem,
    Step,
    TrackFit,
    plain,
    population_model,
    population_settings,
    score,
)
from ballfg.learning.calibration.volume import estimate_with_slopes
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import JUDGED
from ballfg.learning.split import tracks_of
from ballfg.progress import Watch, unwatched

ROUGHLY: Final = 0.3
"""Tolerance of a correction at least: its weights move slowly along directions that hardly change a prediction."""
FIRST: Final = 0.75  # s, the part of each track that teaches a correction: later on contacts say more than the air does


class TooManyFailures(ValueError):  # noqa: N818 - the name is the statement
    """More estimates failed than the config allows."""


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
    mean = np.concatenate((last.mean, chosen.start[len(last.mean) :]))
    config = problem.config.model_copy(update={"tolerance": max(problem.config.tolerance, ROUGHLY)})
    begun = Correction(mean, last.spins, terms)
    posed = replace(problem, model=corrected, chosen=chosen, config=config, correction=begun)
    if noise is None:
        return posed
    # what the calibrated model lacks looks like noise: the correction has the noise about its first step
    posed, step = replace(posed, shown=noise.noise), Step(number=0, mean=plain(mean))
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
    return with_scores(problem, Step(number=0, mean=plain(start)), watch)


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


def fitted_noise(
    problem: Problem, model: AnalyticModel, settings: Settings, watch: Watch = unwatched, *, errors: bool = True
) -> NoiseEstimate | None:
    """The noise of the fitted tracks about the calibrated model; None if undetermined.

    Stated noise may come from the same tracks, and is not its prior; it counts where these tracks say nothing.

    Args: model: with the calibrated coefficients.  settings: with the population as the prior of each coefficient.
        errors: True to compute error bars, which take several times as long.
    """
    if problem.dataset.rough:
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


def about_population(noise: NoiseEstimate, settings: Settings) -> NoiseEstimate:
    """The same noise in settings with another population; spreads of coefficients keep their multiples of it."""
    own = settings.coefficients
    spreads = {name: noise.coefficient_factors[name] * own[name] for name in noise.noise.coefficients}
    found = replace(noise.noise, coefficients=spreads)
    return replace(noise, noise=found, settings=with_noise(settings, found))


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
        mean=plain(population.mean[:size]),
        sigma=plain(population.sigma[:size]),
        spread=plain(population.spread[:size]),
        next_track=plain(population.next_track[:size] if next_track is None else next_track),
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
    wide = settings if groups is None else groups.wide(settings, spins)
    tracks = tracks_of(problem.dataset, names)
    if problem.correction is not None:
        tracks = (track.opening(FIRST) for track in tracks)
    estimates: Iterator[tuple[Estimate, Array | None]]
    if problem.dataset.one_view:
        smoother = Smoother(model, problem.surfaces, wide)
        estimates = map_tracks(partial(estimate_with_slopes, smoother, chosen.names), tracks, len(names), problem.jobs)
    else:
        kind = Smoother if model.measures_plainly else partial(InvertMeasurement, Smoother)
        estimator = kind(model, problem.surfaces, wide)  # without variations: those of groups are found anew
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
    return TrackFit(name=estimate.name, values=plain(mean), sigmas=plain(np.sqrt(np.diag(covariance)))), found
