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

from ballfg.arrays import Array
from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.search.evaluation import (
    LEAST_PREDICTED,
    MOST_FOR_NOISE,
    OBSERVED,
    errors_of,
    noise_about,
)
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import dataset_settings, predict_tracks
from ballfg.estimation.batch import do_all
from ballfg.estimation.noise.estimate import spread_over
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.coefficients import Chosen, choose, values_of, with_values
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
    """The predictions of the search half, as a function of coefficients in prior deviations from those of the model."""

    model: AnalyticModel
    chosen: Chosen
    tracks: tuple[Track, ...]
    holdout: Holdout
    jobs: int
    sigmas: Mapping[tuple[float, str], Array]  # (k, 3) m, by share and track: of the model's own predictions
    own: Array  # (e,) whitened errors of these

    @classmethod
    def of(cls, model: AnalyticModel, chosen: Chosen, holdout: Holdout, jobs: int) -> Self:
        """Of a model and the coefficients that are fitted."""
        parts = holdout.search_tracks
        some = tuple(spread_over((part.track for part in parts), len(parts), MOST_FOR_NOISE))
        asked = cls(model, chosen, some, holdout, jobs, {}, np.zeros(0))
        made = do_all([partial(asked.made, np.zeros(len(chosen.names)), share) for share in SHARES], jobs)
        every = {key: one for of_share in made for key, one in of_share.items()}
        asked = replace(asked, sigmas={key: sigmas for key, (_, sigmas) in every.items()})
        own = [asked._whitened(key, errors) for key, (errors, _) in every.items()]
        return replace(asked, own=np.concatenate(own or [np.zeros(0)]))

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
        return with_values(self.model, self.chosen.names, self.chosen.start + away * self.chosen.sigma)

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


def _chosen(model: AnalyticModel, free: Collection[str]) -> Chosen:
    """Coefficients of these names as their effects declare them; a search lets data decide with wider priors."""
    return choose(model, [name for name, c in model.declared_coefficients().items() if name in free and c.sigma > 0.0])


def _until(share: float, track: Track) -> float:
    return share * track.duration


def fitted_to_predictions(
    model: AnalyticModel, free: Collection[str], holdout: Holdout, jobs: int = 1
) -> AnalyticModel:
    """A copy of a predictive model with the coefficients that predict the search half best, beside their priors.

    Gauss-Newton from the model's own coefficients: slopes by differences there, then by Broyden's rule.

    Args: free: names of the coefficients; those that the model takes as exact stay.  jobs: processes.
    """
    chosen = _chosen(model, free)
    asked = _Predictions.of(model, chosen, holdout, jobs)
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
