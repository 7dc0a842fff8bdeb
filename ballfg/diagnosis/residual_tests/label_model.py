"""Fits the ball's coefficients with scatter of flight and bounces, for the verdicts on spin labels.

The diagnosis' own fit flies deterministically. If real bounces scatter, it adapts coefficients and spins to them, and
right labels then seem wrong. Here each track is smoothed with process noise, and the coefficients are the mean of a
population of tracks. The noise about that model comes from forecasts, as for predictions.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.holdout import EvaluationTrack, Holdout
from ballfg.diagnosis.hypotheses.hypothesis import with_effects
from ballfg.diagnosis.search.process_noise import noise_about
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Settings, Status, dataset_settings
from ballfg.estimation.batch import estimate_tracks
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.coefficients import choose, values_of, with_values
from ballfg.learning.calibration.population import evidence, fit_population
from ballfg.tracks.noise import TrackNoise

MOST_ROUNDS = 5
"""Largest number of fits of the population; usual are three, from coefficients far off."""
SETTLED = 0.1
"""Change of the population's mean, in standard errors, below which it has converged."""


def scattering_model(
    model: AnalyticModel,
    declared: AnalyticModel,
    tracks: Sequence[EvaluationTrack],
    holdout: Holdout,
    tracker: TrackNoise | None = None,
    *,
    jobs: int = 1,
) -> tuple[AnalyticModel, Settings]:
    """A corrected model with refitted coefficients, and the settings for predictions with it.

    The declared coefficients of flight and bounce are refitted to tracks with spin labels, about their declared values;
    added effects and values that differ between tracks stay. The tracker's memory and jitter are used if found.
    """
    plain = with_effects(model)
    plain.variations = model.variations
    usual = dataset_settings(holdout.dataset, plain)  # no noise is stated in this model
    names = [n for n in declared_free(declared) if not n.startswith("measurement.") and n not in model.variations]
    if names:
        plain = _of_population(plain, declared, names, tracks, holdout, usual, jobs)
    plain.noise = noise_about(plain, tracks, holdout.dataset, tracker, jobs=jobs)
    settings = dataset_settings(holdout.dataset, plain)
    # the labels' estimated error includes wrong labels: right ones have the dataset's error
    return plain, replace(settings, spin_label_noise=usual.spin_label_noise)


def _of_population(
    model: AnalyticModel,
    declared: AnalyticModel,
    names: Sequence[str],
    tracks: Sequence[EvaluationTrack],
    holdout: Holdout,
    settings: Settings,
    jobs: int,
) -> AnalyticModel:
    """The model with the mean of the population in place of the named coefficients."""
    chosen, mean = choose(declared, names), values_of(model, names)
    priors = {**settings.coefficients, **dict(zip(names, chosen.sigma.tolist(), strict=True))}
    for _ in range(MOST_ROUNDS):
        moving = with_values(model, names, mean)
        smoother = make_estimator("smoother", moving, holdout.surfaces, replace(settings, coefficients=priors))
        estimates = estimate_tracks(smoother, (part.track for part in tracks), len(tracks), jobs)
        found = []
        for estimate in (e for e in estimates if e.status is Status.OK):
            columns = [estimate.coefficient_names.index(name) for name in names]
            covariance = estimate.coefficient_covariance[np.ix_(columns, columns)]
            found.append(evidence(estimate.coefficients[columns], covariance, mean, chosen.sigma))
        if not found:
            return model
        population = fit_population(found, chosen.start, chosen.sigma, chosen.low, chosen.high)
        before, mean = mean, population.mean
        if np.abs((mean - before) / population.sigma).max() < SETTLED:
            break
    return with_values(model, names, mean)
