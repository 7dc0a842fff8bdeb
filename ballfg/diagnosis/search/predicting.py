"""Fits the coefficients of a model that lacks something to predictions, by a prediction error method.

Where a model is right, the likelihood of tracks says all about its coefficients. Where it lacks something, the most
probable coefficients describe short motion best, and predictions drift to one side. Errors of predictions from several
moments to the end of each track correct that; from a single moment, coefficients would suit that horizon alone
[Farina and Piroddi, Simulation error minimization and multi-step prediction error methods, 2011].
"""

import copy
from collections.abc import Collection
from functools import partial
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.search.evaluation import MOST_FOR_NOISE, OBSERVED, errors_of, noise_about
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Estimator, dataset_settings
from ballfg.estimation.noise.estimate import spread_over
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.coefficients import Chosen, choose, values_of, with_values
from ballfg.learning.calibration.forecasts import Forecasts, moments
from ballfg.tracks.noise import TrackNoise

DIFFERENCE: Final = 0.03  # Step of a difference, in prior deviations of the coefficient
MOST_STEPS: Final = 6
WORTH_A_STEP: Final = 0.5  # Least promised gain of a step, natural units
MOST_ROUNDS: Final = 3  # Largest number of times that noise and coefficients are found in turn
WORTH_A_ROUND: Final = 0.05  # Gain in the log likelihood of a coordinate that may bring another one
TOLD: Final = 0.2  # Change of a coefficient, in prior deviations, from which on it is told
MOST_TOLD: Final = 3


def forecasts(model: AnalyticModel, chosen: Chosen, holdout: Holdout, jobs: int) -> Forecasts:
    """The predictions of the search half as a function of coefficients, in prior deviations from those of the model."""
    parts = holdout.search_tracks
    some = spread_over((part.track for part in parts), len(parts), MOST_FOR_NOISE)
    size = len(chosen.names)
    return Forecasts.of(partial(_estimator, model, chosen, holdout), size, tuple(some), moments(OBSERVED), jobs=jobs)


def _estimator(model: AnalyticModel, chosen: Chosen, holdout: Holdout, away: Array) -> Estimator:
    moved = _moved(model, chosen, away)
    return make_estimator("smoother", moved, holdout.surfaces, dataset_settings(holdout.dataset, moved))


def _moved(model: AnalyticModel, chosen: Chosen, away: Array) -> AnalyticModel:
    """A copy of the model with other coefficients."""
    return with_values(model, chosen.names, chosen.start + away * chosen.sigma)


def _chosen(model: AnalyticModel, free: Collection[str]) -> Chosen:
    """Coefficients of these names as their effects declare them; a search lets data decide with wider priors."""
    return choose(model, [name for name, c in model.declared_coefficients().items() if name in free and c.sigma > 0.0])


def fitted_to_predictions(
    model: AnalyticModel, free: Collection[str], holdout: Holdout, jobs: int = 1
) -> AnalyticModel:
    """A copy of a predictive model with the coefficients that predict the search half best, beside their priors.

    Gauss-Newton from the model's own coefficients: slopes by differences there, then by Broyden's rule.

    Args: free: names of the coefficients; those that the model takes as exact stay.  jobs: processes.
    """
    chosen = _chosen(model, free)
    asked = forecasts(model, chosen, holdout, jobs)
    if not chosen.names or not asked.sigmas:
        return model
    low, high = ((end - chosen.start) / chosen.sigma for end in (chosen.low, chosen.high))
    steps = np.diag(np.where(high > DIFFERENCE, DIFFERENCE, -DIFFERENCE))
    known = np.isfinite(asked.own)
    weights = asked.weights(np.where(known, asked.own, 0.0))[known]
    errors = weights * asked.own[known]
    columns = [weights * column[known] for column in asked.errors([*steps])]
    slopes = np.stack([np.nan_to_num(c - errors) / s for c, s in zip(columns, steps.diagonal(), strict=True)], axis=1)
    away, damping = np.zeros(len(steps)), 1.0
    for _ in range(MOST_STEPS):
        information, score = slopes.T @ slopes + np.eye(len(away)), slopes.T @ errors + away
        damped = information + (damping - 1.0) * np.diag(information.diagonal())
        step = np.clip(away - np.linalg.solve(damped, score), low, high) - away
        if -(score @ step + 0.5 * step @ information @ step) < WORTH_A_STEP:
            break
        there = weights * asked.errors([away + step])[0][known]
        before, after = errors @ errors + away @ away, there @ there + (away + step) @ (away + step)
        if np.isfinite(after):
            slopes = slopes + np.outer(there - errors - slopes @ step, step) / (step @ step)
        if after < before:
            away, errors, damping = away + step, there, max(1.0, damping / 4.0)
        else:
            damping *= 4.0
    return _moved(model, chosen, away)


def best_predicting(
    model: AnalyticModel,
    free: Collection[str],
    holdout: Holdout,
    tracker: TrackNoise | None = None,
    jobs: int = 1,
) -> AnalyticModel:
    """The model that predicts the search half best: itself, or fitted to predictions with the old or its own noise.

    Own noise weighs the predictions anew, so that a better model may follow.

    Args: free: as in `fitted_to_predictions`.  tracker: fixed memory and jitter of the noise.
    """

    def judged(one: AnalyticModel) -> tuple[float, AnalyticModel]:
        return errors_of(one, holdout, holdout.search_tracks, jobs).log_likelihood, one

    best = judged(model)
    for _ in range(MOST_ROUNDS):
        fitted = fitted_to_predictions(best[1], free, holdout, jobs)
        own = copy.deepcopy(fitted)
        own.noise = noise_about(own, holdout.search_tracks, holdout.dataset, tracker, jobs=jobs)
        found = max(judged(fitted), judged(own), key=lambda one: one[0])
        if found[0] <= best[0]:
            break
        before, best = best[0], found
        if found[0] - before < WORTH_A_ROUND:
            break
    return best[1]


def told_shifts(model: AnalyticModel, before: AnalyticModel, free: Collection[str]) -> str:
    """A sentence on the coefficients that predict best where they are not the most probable ones; none: empty."""
    chosen = _chosen(model, free)
    was = values_of(before, chosen.names)
    moved = np.abs(chosen.start - was) / chosen.sigma
    most = [k for k in np.argsort(-moved, kind="stable")[:MOST_TOLD] if moved[k] >= TOLD]
    if not most:
        return ""
    words = [
        f"{chosen.names[k].partition('.')[2]} {now:.3g} for {was[k]:.3g} {chosen.units[k]}".removesuffix(" 1")
        for k in most
        for now in [chosen.start[k]]
    ]
    return (
        "Something is lacking still: the corrected model has the coefficients that predict best, not the most probable "
        f"ones, among them {', '.join(words)}."
    )
