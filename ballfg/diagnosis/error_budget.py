"""Computes error budgets: the squared error that a model expects on held-out tracks, by its sources."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ballfg.arrays import Mask
from ballfg.diagnosis.budget import ErrorBudget
from ballfg.diagnosis.fit.holdout import EvaluationTrack, Holdout, analytic, hold_out
from ballfg.diagnosis.residual_tests.tracker_errors import look_at_tracker
from ballfg.diagnosis.search.evaluation import OBSERVED, errors_of, noise_about, predictive_model
from ballfg.diagnosis.search.stamp_effects import as_declared, first_fit, with_errors_of_counting
from ballfg.dynamics import BallModel, Surfaces
from ballfg.estimation import Settings, dataset_settings
from ballfg.estimation.noise.estimate import linearised
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.estimation.noise.parameters import noise_of
from ballfg.estimation.noise.sources import SOURCES, squares_by_source
from ballfg.learning.calibration.forecasts import LEAST_PREDICTED
from ballfg.tracks import Dataset


def error_budget(
    dataset: Dataset, model: BallModel, *, jobs: int = 1, watch: Callable[[str], None] | None = None
) -> ErrorBudget:
    """The parts of the prediction error of a model as it is, with its coefficients and noise fitted to half the tracks.

    Args:
        dataset: tracks. Every second one is fitted; the others are predicted, the first 40 % of each observed.
        model: the analytic model; errors of stamps that the tracks show are the only effects added to it.
        jobs: processes.
        watch: called with a line for each stage.
    Raises:
        TypeError: if the model is a learned one.
        ValueError: if there are too few tracks, none with a flight that is long enough, or none that is predicted
            without a hit from samples of which most are no outliers.
    """
    model, tell = analytic(model), watch or (lambda line: None)
    holdout = with_errors_of_counting(hold_out(dataset, model, jobs, tell))
    tell("fitting the model and its noise")
    fitted = predictive_model(holdout, jobs, first_fit(model, holdout))
    tracker = look_at_tracker(fitted, holdout, jobs)
    if tracker.findings:
        fitted.noise = noise_about(fitted, holdout.search_tracks, holdout.dataset, tracker.noise, jobs=jobs)
    tell("predicting the other half")
    before, after = (
        errors_of(m, holdout, holdout.held_out_tracks, jobs) for m in (as_declared(fitted, holdout.stamps), fitted)
    )
    budget = budget_of(fitted, holdout, before.prediction_rmse_mm, after.prediction_rmse_mm, jobs)
    if budget is None:
        raise ValueError(
            "tracks must be predicted through flights and bounces alone; the model sees a hit in each of them, or more "
            "outliers than samples. Give it right stamps and coefficients, or longer tracks."
        )
    return budget


def budget_of(
    model: BallModel, holdout: Holdout, before_mm: float, after_mm: float, jobs: int = 1
) -> ErrorBudget | None:
    """The budget of measured prediction errors; None if the model sees a hit in each track.

    Args: model: with the fitted noise and launcher.  before_mm, after_mm: of the held-out half, without the named
        effects and with them.
    """
    settings = dataset_settings(holdout.dataset, model)
    expected = expected_squares(model, holdout.held_out_tracks, holdout.surfaces, settings, jobs)
    return None if expected is None else ErrorBudget.of(*expected, before_mm, after_mm)


def expected_squares(
    model: BallModel, tracks: Sequence[EvaluationTrack], surfaces: Surfaces, settings: Settings, jobs: int = 1
) -> tuple[dict[str, float], int] | None:
    """Expected squared prediction errors by source, over the samples that `prediction_errors` counts.

    The tracks are linearised about their estimates from all samples; those in which the model sees a hit are left out.

    Returns: mm^2, means over the predicted samples by name, and the number of tracks; None without any.
    """
    linear = linearised(model, surfaces, settings, [t.track for t in tracks], jobs=jobs)
    if linear is None:
        return None
    observed, predicted = _samples(linear, tracks)
    predicted &= (predicted.sum(axis=1) >= LEAST_PREDICTED)[:, None]
    if not bool(predicted.any()):
        return None
    if settings.launcher is not None:
        settings = replace(settings, spin_label_noise=settings.launcher.sigma)
    noise = noise_of([], np.empty((1, 0)), settings)
    squares = squares_by_source(linear, noise, settings.velocity_prior, observed, predicted).sum(axis=0)
    means = (1e6 * squares / predicted.sum()).tolist()
    return dict(zip(SOURCES, means, strict=True)), int(predicted.any(axis=1).sum())


def _samples(linear: LinearTracks, tracks: Sequence[EvaluationTrack]) -> tuple[Mask, Mask]:
    """(t, n) bool, observed and predicted samples of the tracks that are linearised as a whole; none of the others.

    Nor of those of which most observed samples are outliers: a prediction knows what this linearisation leaves out.
    """
    observed, predicted = np.zeros((2, *linear.times.shape), dtype=bool)
    for row, number in enumerate(linear.numbers):
        track, moving = tracks[number].track, np.diff(linear.times[row]) > 0.0
        if np.flatnonzero(moving)[-1] + 2 == len(track):
            seen = len(track.opening(OBSERVED * track.duration))
            if linear.used[row, :seen].mean() > 0.5:
                observed[row, :seen], predicted[row, seen : len(track)] = True, True
    return observed, predicted
