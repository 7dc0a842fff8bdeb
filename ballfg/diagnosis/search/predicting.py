"""Fits the coefficients of a model that lacks something to predictions, by a prediction error method.

Where a model is right, the likelihood of tracks says all about its coefficients. Where it lacks something, the most
probable coefficients describe short motion best, and predictions drift to one side. Errors of predictions from several
moments to the end of each track correct that; from a single moment, coefficients would suit that horizon alone
[Farina and Piroddi, Simulation error minimization and multi-step prediction error methods, 2011].
"""

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Self

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.diagnosis.fit.holdout import EvaluationTrack, Holdout
from ballfg.diagnosis.search.evaluation import (
    LEAST_PREDICTED,
    MOST_FOR_NOISE,
    OBSERVED,
    errors_of,
    noise_about,
)
from ballfg.dynamics import AnalyticModel, Coefficient
from ballfg.estimation import dataset_settings, predict_tracks
from ballfg.estimation.batch import do_all
from ballfg.estimation.noise.estimate import spread_over
from ballfg.estimation.registry import make_estimator
from ballfg.tracks import Track
from ballfg.tracks.noise import TrackNoise

SHARES: Final = (OBSERVED / 2.0, OBSERVED, (1.0 + OBSERVED) / 2.0)  # Observed shares of a track; the rest is predicted
NUMBERS: Final = 3.0  # What the errors of one track's predictions count as: they hang together, along each axis
FAR: Final = 2.0  # Whitened error, root mean square, from which on a prediction counts less (Huber)
DIFFERENCE: Final = 0.03  # Step of a difference, in prior deviations of the coefficient
MOST_STEPS: Final = 6
WORTH_A_STEP: Final = 0.5  # Least promised gain of a step, natural units
MOST_ROUNDS: Final = 3  # Largest number of times that noise and coefficients are found in turn
WORTH_A_ROUND: Final = 0.05  # Gain in the log likelihood of a coordinate that may bring another one
TOLD: Final = 0.2  # Change of a coefficient, in prior deviations, from which on it is told
MOST_TOLD: Final = 3


@dataclass(frozen=True)
class _Predictions:
    """The predictions of some tracks, as a function of coefficients in prior deviations from those of the model."""

    model: AnalyticModel
    names: tuple[str, ...]
    start: Array  # (p,) the model's values
    sigma: Array  # (p,)
    tracks: tuple[Track, ...]
    holdout: Holdout
    jobs: int
    sigmas: Mapping[tuple[float, str], Array]  # (k, 3) m, by share and track: of the model's own predictions

    @classmethod
    def of(
        cls,
        model: AnalyticModel,
        priors: Mapping[str, Coefficient],
        parts: Sequence[EvaluationTrack],
        holdout: Holdout,
        jobs: int,
    ) -> Self:
        """Of a model and the coefficients that are fitted, with their priors."""
        values = {name: float(value.detach()) for name, value in model.named_parameters() if name in priors}
        some = tuple(spread_over((part.track for part in parts), len(parts), MOST_FOR_NOISE))
        sigma = np.array([priors[name].sigma for name in values])
        about = cls(model, tuple(values), np.array([*values.values()]), sigma, some, holdout, jobs, {})
        made = do_all([partial(about.made, np.zeros(len(values)), share) for share in SHARES], jobs)
        sigmas = {key: sigma for of_share in made for key, (_, sigma) in of_share.items()}
        return replace(about, sigmas=sigmas)

    def made(self, away: Array, share: float) -> dict[tuple[float, str], tuple[Array, Array]]:
        """Errors (k, 3) and their standard deviations, m, by share and track."""
        model = self.at(away)
        settings = dataset_settings(self.holdout.dataset, model)
        estimator = make_estimator("smoother", model, self.holdout.surfaces, settings)
        predictions = predict_tracks(estimator, self.tracks, len(self.tracks), partial(_until, share))
        kept = (p for p in predictions if len(p.times) >= LEAST_PREDICTED)
        return {(share, p.name): (p.positions - p.measured, p.sigmas) for p in kept}

    def at(self, away: Array) -> AnalyticModel:
        """A copy of the model with other coefficients."""
        model = copy.deepcopy(self.model)
        parameters = dict(model.named_parameters())
        with torch.no_grad():
            for name, value in zip(self.names, (self.start + away * self.sigma).tolist(), strict=True):
                parameters[name].fill_(value)
        return model

    def errors(self, away: Sequence[Array]) -> list[Array]:
        """(e,) whitened errors at each of some coefficients (p,); those of a track count as `NUMBERS`."""
        tasks = [partial(self.made, one, share) for one in away for share in SHARES]
        made, found = do_all(tasks, self.jobs), []
        for k in range(0, len(made), len(SHARES)):
            every = {key: errors for of_share in made[k : k + len(SHARES)] for key, (errors, _) in of_share.items()}
            found.append(np.concatenate([self._whitened(key, every.get(key)) for key in self.sigmas]))
        return found

    def _whitened(self, key: tuple[float, str], errors: Array | None) -> Array:
        sigmas = self.sigmas[key]
        if errors is None:
            return np.full(sigmas.size, np.nan)
        return np.asarray((errors / sigmas).ravel() * np.sqrt(NUMBERS / (len(SHARES) * sigmas.size)))

    def weights(self, errors: Array) -> Array:
        """(e,) square roots of the predictions' weights by their whitened errors."""
        ends = np.cumsum([sigmas.size for sigmas in self.sigmas.values()])[:-1]
        parts = np.split(errors, ends)
        size = [np.sqrt((part**2).sum() * len(SHARES) / NUMBERS) for part in parts]
        return np.concatenate([np.full(len(p), np.sqrt(FAR / max(FAR, s))) for p, s in zip(parts, size, strict=True)])


def _priors(model: AnalyticModel, free: Collection[str]) -> dict[str, Coefficient]:
    """Coefficients of these names as their effects declare them; a search lets data decide with wider priors."""
    return {name: c for name, c in model.declared_coefficients().items() if name in free and c.sigma > 0.0}


def _until(share: float, track: Track) -> float:
    return share * track.duration


def fitted_to_predictions(
    model: AnalyticModel,
    free: Collection[str],
    parts: Sequence[EvaluationTrack],
    holdout: Holdout,
    jobs: int = 1,
) -> AnalyticModel:
    """A copy of a predictive model with the coefficients that predict some tracks best, beside their priors.

    Gauss-Newton from the model's own coefficients: slopes by differences there, then by Broyden's rule.

    Args: free: names of the coefficients; those that the model takes as exact stay.  parts: tracks.  jobs: processes.
    """
    priors = _priors(model, free)
    asked = _Predictions.of(model, priors, parts, holdout, jobs)
    if not asked.names or not asked.sigmas:
        return model
    low, high = (np.array([getattr(priors[name], end) for name in asked.names]) for end in ("low", "high"))
    low, high = (low - asked.start) / asked.sigma, (high - asked.start) / asked.sigma
    steps = np.diag(np.where(high > DIFFERENCE, DIFFERENCE, -DIFFERENCE))
    errors, *moved = asked.errors([np.zeros(len(steps)), *steps])
    known = np.isfinite(errors)
    weights = asked.weights(np.where(known, errors, 0.0))[known]
    errors = weights * errors[known]
    columns = [weights * column[known] for column in moved]
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
    return asked.at(away)


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
        fitted = fitted_to_predictions(best[1], free, holdout.search_tracks, holdout, jobs)
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
    values = [{name: float(value.detach()) for name, value in one.named_parameters()} for one in (model, before)]
    priors = _priors(model, free)
    moved = {name: abs(values[0][name] - values[1][name]) / c.sigma for name, c in priors.items()}
    most = [name for name in sorted(moved, key=lambda name: -moved[name]) if moved[name] >= TOLD][:MOST_TOLD]
    if not most:
        return ""
    changes = ((name, *(f"{of[name]:.3g}" for of in values), priors[name].unit) for name in most)
    words = [f"{name.partition('.')[2]} {now} for {was} {unit}".removesuffix(" 1") for name, now, was, unit in changes]
    return (
        "Something is lacking still: the corrected model has the coefficients that predict best, not the most probable "
        f"ones, among them {', '.join(words)}."
    )
