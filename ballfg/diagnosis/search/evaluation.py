"""Evaluates a model on other tracks than those of its fit, by predictions of unseen parts and by likelihood."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.fit import fit_problem, reachable
from ballfg.diagnosis.fit.holdout import EvaluationTrack
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.stretches import Stretches, joined
from ballfg.diagnosis.result import Errors, PredictedPath
from ballfg.dynamics import BallModel, Surfaces
from ballfg.estimation import Settings, predict_tracks
from ballfg.estimation.noise.forecasts import NINETY
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.prediction.apexes import flight_bounds, measured_apexes, path_apex
from ballfg.tracks import Track

OBSERVED = 0.4
"""Observed share of each track; the rest is predicted."""
LEAST_PREDICTED = 3
"""Least number of predicted samples."""


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


def on_others(fitted: Fit, others: Stretches) -> Fit:
    """The fit of new first states to stretches of other tracks, with all else as fitted."""
    stretches = reachable(fitted.problem.model, others, fitted.problem.by_stretch(fitted.unknowns.values, others))
    problem = replace(fitted.problem, stretches=stretches, shared=False)
    unknowns = replace(fitted.unknowns, starts=stretches.starts.numpy().copy())
    return fit_problem(problem, unknowns, fitted.noise, settle_noise=False)


def on_all(fitted: Fit, others: Fit) -> Fit:
    """The fit to the tracks of two fits of one problem, at the same noise. others: as `on_others(fitted, ...)`."""
    own, more = fitted.problem.stretches, others.problem.stretches
    stretches = joined([own, replace(more, track=more.track + own.track.max() + 1)])
    starts = np.concatenate((fitted.unknowns.starts, others.unknowns.starts))
    unknowns = replace(fitted.unknowns, starts=starts)
    return fit_problem(replace(fitted.problem, stretches=stretches), unknowns, fitted.noise, settle_noise=False)
