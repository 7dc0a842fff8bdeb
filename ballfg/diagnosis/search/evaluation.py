"""Turns fits into models for predictions, and evaluates them on other tracks by their unseen parts.

The fit is deterministic, so that all unmodelled motion is in the residual. Predictions need that motion as noise: too
little of it makes them overconfident, too much makes them ignore the observed part. `estimate_noise` determines it by
forecasts within the tracks of the search half.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.diagnosis.evidence.likelihood import posterior
from ballfg.diagnosis.evidence.rows import random_motion, rows_of
from ballfg.diagnosis.evidence.sizes import settled
from ballfg.diagnosis.fit.effects import with_coefficients, with_effects
from ballfg.diagnosis.fit.fit import fit_problem, reachable
from ballfg.diagnosis.fit.holdout import EvaluationTrack, Holdout
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.stretches import Stretches, joined
from ballfg.diagnosis.result import Errors, PredictedPath
from ballfg.dynamics import AnalyticModel, BallModel, Surfaces
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.population import SpinGroup, SpinPopulation
from ballfg.dynamics.trained import Trained
from ballfg.estimation import Settings, dataset_settings, dataset_surfaces, estimate_noise, predict_tracks
from ballfg.estimation.noise.estimate import spread_over
from ballfg.estimation.noise.forecasts import NINETY
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.learning.calibration.forecasts import LEAST_PREDICTED
from ballfg.prediction.apexes import flight_bounds, measured_apexes, path_apex
from ballfg.tracks import Dataset, Track
from ballfg.tracks.noise import TrackNoise

OBSERVED = 0.4  # Observed share of each track; the rest is predicted


def prediction_errors(
    model: BallModel, tracks: Sequence[EvaluationTrack], surfaces: Surfaces, settings: Settings, jobs: int = 1
) -> Errors:
    """Errors of `ballfg predict` with a model.

    Args:
        model: with the fitted noise and launcher in `trained`.
        tracks: outside of its fit.
        surfaces: of the dataset with this model.
        settings: of the dataset with this model.
        jobs: processes.
    Returns: errors over all tracks, in mm and without unit, with the predictions.
    Raises: ValueError: if no track has enough samples to predict.
    """
    estimator = make_estimator("smoother", model, surfaces, settings)
    observed = [t.track for t in tracks]
    predictions = predict_tracks(estimator, observed, len(observed), lambda t: OBSERVED * t.duration, jobs=jobs)
    pairs = [(t, p) for t, p in zip(tracks, predictions, strict=True) if len(p.times) >= LEAST_PREDICTED]
    if not pairs:
        raise ValueError(
            f"tracks must leave {LEAST_PREDICTED} samples after the first {OBSERVED:.0%} of them, to judge predictions "
            "by; none does. Record longer tracks."
        )
    squares = [((p.positions - p.measured) ** 2).sum(axis=-1) for _, p in pairs]
    whitened = [(p.positions - p.measured) / p.sigmas for _, p in pairs]
    scores = np.concatenate(whitened)
    sigmas = np.concatenate([p.sigmas for _, p in pairs])
    apexes = np.concatenate([_apex_distances(t, p) for t, p in pairs])
    return Errors(
        1e3 * float(np.sqrt(np.concatenate(squares).mean())),
        1e3 * float(np.sqrt((apexes**2).mean())) if len(apexes) else float("nan"),
        float((scores**2).mean()),
        float((-0.5 * scores**2 - np.log(sigmas)).mean() - 0.5 * np.log(2 * np.pi)),
        1e3 * np.sqrt([s.mean() for s in squares]),
        float((np.abs(scores) < NINETY).mean()),
        float(np.median((scores**2).sum(axis=-1))),
        tuple(_path(t.track, p) for t, p in pairs),
        error_of_mean([own**2 for own in whitened]),
    )


def error_of_mean(by_track: Sequence[Array]) -> float:
    """Standard error of the mean over all numbers, grouped by track; NaN for a single track."""
    if len(by_track) < 2:
        return float("nan")
    sums, counts = np.array([s.sum() for s in by_track]), np.array([s.size for s in by_track])
    left = sums - counts * sums.sum() / counts.sum()
    return float(np.sqrt((left**2).sum() * len(by_track) / (len(by_track) - 1)) / counts.sum())


def _path(track: Track, prediction: TrackPrediction) -> PredictedPath:
    seen = track.times < prediction.times[0]
    since = prediction.times - track.times[seen][-1]
    return PredictedPath(track.name, track.positions[seen], since, prediction.positions, prediction.measured)


def _apex_distances(evaluated: EvaluationTrack, prediction: TrackPrediction) -> Array:
    """(a,) m between measured and predicted apexes of flights with an unobserved apex."""
    track, end = evaluated.track, float(prediction.times[0])
    points, when = measured_apexes(track.times, track.positions, evaluated.bounces)
    found = []
    for point, time, flight in zip(points, when, flight_bounds(track.times, evaluated.bounces), strict=False):
        if np.isfinite(time) and time > end:
            predicted, _ = path_apex(prediction.times, prediction.positions, *flight)
            found.append(float(np.linalg.norm(predicted - point)))
    return np.array([d for d in found if np.isfinite(d)])


def on_all(fitted: Fit, others: Stretches) -> Fit:
    """The fit to stretches of other tracks too, at the same noise, from first states that fit them with all else so."""
    reached = reachable(fitted.problem.model, others, fitted.problem.by_stretch(fitted.unknowns.values, others))
    unknowns = replace(fitted.unknowns, starts=reached.starts.numpy().copy())
    problem = replace(fitted.problem, stretches=reached, shared=False)
    beside = fit_problem(problem, unknowns, fitted.noise, settle_noise=False)
    own, more = fitted.problem.stretches, beside.problem.stretches
    stretches = joined([own, replace(more, track=more.track + own.track.max() + 1)])
    starts = np.concatenate((fitted.unknowns.starts, beside.unknowns.starts))
    unknowns = replace(fitted.unknowns, starts=starts)
    return fit_problem(replace(fitted.problem, stretches=stretches), unknowns, fitted.noise, settle_noise=False)


MOST_FOR_NOISE = 25  # Number of tracks for the noise, evenly spread; more move no number by more than its error bar
SPREAD = 0.3  # Prior median of the spread of coefficients between tracks, over the prior of an unfitted coefficient


def fitted_model(fit: Fit) -> AnalyticModel:
    """A copy of a fit's model with the fitted coefficients, without deviations, noise and launcher."""
    return with_coefficients(fit.problem.model, fit.unknowns.values)


def calibrated_model(fit: Fit, embedding: SpinEmbedding) -> AnalyticModel:
    """The fitted model, for estimates and predictions; embedding: with the names of the fit's launcher settings."""
    model = fitted_model(fit)
    model.variations = fit.variations()
    scale, labelled = float(np.sqrt((fit.noise.position**2).mean())), fit.problem.stretches.labelled
    if labelled.all():
        model.trained = Trained(position_scale=scale, spin_noise=fit.noise.label)
    elif embedding.categories:
        model.trained = Trained(position_scale=scale)
        model.spins = _spins(fit, embedding)
    else:  # settings are numbers: a spin for each of them, all with one scatter
        learned = SpinEmbedding(embedding.labels, {}, torch.from_numpy(fit.unknowns.launcher)).requires_grad_(False)
        scatter = float(np.sqrt((fit.noise.spin**2).mean()))
        model.trained = Trained(position_scale=scale, launcher=learned, spin_noise=scatter)
    return model


def _spins(fit: Fit, embedding: SpinEmbedding) -> SpinPopulation:
    """The population of the groups' spins; embedding: one category for each of the fit's launcher settings."""
    ((by, names),) = embedding.categories.items()
    counts = fit.problem.stretches.settings.sum(axis=0)
    groups = {
        name: SpinGroup(tuple(mean.tolist()), tuple(fit.noise.spin.tolist()), max(int(count), 1))
        for name, mean, count in zip(names, fit.unknowns.launcher, counts, strict=True)
    }
    return SpinPopulation(by, groups)


def noise_about(
    model: BallModel,
    tracks: Sequence[EvaluationTrack],
    dataset: Dataset,
    tracker: TrackNoise | None = None,
    *,
    jobs: int = 1,
) -> TrackNoise | None:
    """The noise of tracks about a calibrated model; None if they are too short.

    Args: model: with `trained`.  tracks: of its fit.  tracker: fixed memory and jitter; None: the dataset's.
    """
    tracker = tracker or TrackNoise()
    settings = dataset_settings(dataset, model)
    settings = replace(
        settings,
        coefficients={name: SPREAD * sigma for name, sigma in coefficient_sigmas(model).items()},
        memory=tracker.memory or settings.memory,
        memory_time=tracker.memory_time or settings.memory_time,
        stamp_jitter=tracker.stamp_jitter or settings.stamp_jitter,
    )
    some, surfaces = spread_over((p.track for p in tracks), len(tracks), MOST_FOR_NOISE), dataset_surfaces(dataset)
    whole = math.inf  # the model is judged by predictions that go on to the end of a track
    found = estimate_noise(model, surfaces, settings, some, tracker_known=True, longest=whole, errors=False, jobs=jobs)
    if found is None:
        return None
    noise = replace(found.noise, stamp_jitter=settings.stamp_jitter or None)
    return replace(noise, memory=settings.memory, memory_time=settings.memory_time) if settings.has_memory else noise


def for_next_shot(fit: Fit) -> Fit:
    """The fit with the scatter of a further shot's spin about its launcher's mean, from the evidence of the tracks.

    The fit's own scatter holds what its model lacks too: beside random motion, that counts as motion. The doubt about
    the mean comes on top: shots that happen to agree show no scatter.
    """
    problem, unknowns = fit.problem, fit.unknowns
    if problem.stretches.labelled.all():
        return fit
    values = np.array([unknowns.values[name] for name in problem.free])
    away = np.concatenate((problem.centres - values, -unknowns.launcher.ravel()))
    likelihood, noise = settled(rows_of(fit, random_motion(fit)), problem.common_precision, away)
    found = posterior(likelihood.reduced(noise)[0], problem.common_precision, away)
    of_launcher = np.diagonal(found.covariance)[len(values) :].reshape(-1, 3)
    doubt = (problem.stretches.settings**2 @ of_launcher).mean(axis=0)
    scatter = np.sqrt((fit.noise.spin * np.exp(noise.spin[1:])) ** 2 + doubt)
    return replace(fit, noise=replace(fit.noise, spin=scatter))


def next_shot_model(fit: Fit, embedding: SpinEmbedding, like: AnalyticModel | None = None) -> AnalyticModel:
    """The fitted model for a further shot, without its noise.

    Args: embedding: as in `calibrated_model`.  like: a model; where it has no population of spins, this one has none.
    """
    model = calibrated_model(for_next_shot(fit), embedding)
    return model if like is None or has_population(like) or not has_population(model) else without_population(model)


def has_population(model: BallModel) -> bool:
    """True if a model knows more of the launchers' spins than the prior of any spin."""
    return model.spins is not None or (model.trained is not None and model.trained.launcher is not None)


def without_population(model: AnalyticModel) -> AnalyticModel:
    """A calibrated model without what it knows of the launchers' spins, and without noise."""
    bare, trained = with_effects(model), model.trained or Trained()
    bare.variations, bare.trained = model.variations, Trained(position_scale=trained.position_scale)
    return bare


def predictive_model(holdout: Holdout, jobs: int, fit: Fit) -> AnalyticModel:
    """The fitted model with its own noise on the search half, and with its population of spins if that predicts better.

    With the noise of a model that lacks an effect, predictions would hardly follow the observed part. Spins that such a
    model needs differ from flight to flight more than a launcher's: a population may be worse than the prior of any.
    """
    model = next_shot_model(fit, holdout.launcher.embedding)
    model.noise = noise_about(model, holdout.search_tracks, holdout.dataset, jobs=jobs)
    if not has_population(model):
        return model
    bare = unpopulated_model(model, holdout, jobs)
    return max(model, bare, key=lambda one: errors_of(one, holdout, holdout.search_tracks, jobs).log_likelihood)


def unpopulated_model(model: AnalyticModel, holdout: Holdout, jobs: int) -> AnalyticModel:
    """A predictive model without its population, with its own noise beside the same tracker."""
    bare = without_population(model)
    bare.noise = noise_about(bare, holdout.search_tracks, holdout.dataset, model.noise, jobs=jobs)
    return bare


def errors_of(model: BallModel, holdout: Holdout, tracks: Sequence[EvaluationTrack], jobs: int) -> Errors:
    """Errors of a model's predictions on tracks of one half."""
    settings = dataset_settings(holdout.dataset, model)
    return prediction_errors(model, tracks, holdout.surfaces, settings, jobs)
