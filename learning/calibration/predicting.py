"""Moves the means of a calibration towards those that predict its tracks best, as far as left-out tracks gain by it.

Where a model is right, the likelihood of the tracks says all about its numbers. Where it lacks something, the most
probable numbers describe short motion best, and predictions drift to one side. Those that predict best are found by a
prediction error method [M. Farina, L. Piroddi, Simulation error minimization and multi-step prediction error methods,
2011]. Which of both to follow is for tracks to say that had no part in either: the predictions, linearised once, are
fitted beside a prior about the most probable numbers, whose precision cross-validation over the tracks chooses; as far
as the likelihood gave it: what a model states of its coefficients holds in full.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effects.generic import DOUBTS, FUNCTIONS
from ballfg.estimation import Estimator, Settings
from ballfg.estimation.noise.estimate import NoiseEstimate
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.calibrate import about_population, fitted_noise
from ballfg.learning.calibration.correction import doubt_sigmas
from ballfg.learning.calibration.forecasts import Forecasts, moments, weight
from ballfg.learning.calibration.problem import Problem, Step, plain, population_model, population_settings
from ballfg.learning.evaluation import log_density
from ballfg.learning.split import tracks_of
from ballfg.progress import Watch, unwatched

DIFFERENCE: Final = 0.3  # Step of a difference, in standard errors of a mean spin
PRECISIONS: Final = (np.inf, 1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
"""Of the prior about the most probable numbers, in what the likelihood gives them; with the first one they stay."""
MOST_STEPS: Final = 6  # Times that predictions are weighed anew by how far they miss
FOLDS: Final = 5  # Parts of the fitted tracks that are left out in turn
LEAST: Final = 4  # Fitted tracks that a choice needs


@dataclass(frozen=True)
class Numbers:
    """The p numbers that are moved, in standard errors: first coefficients, then spins of groups, then doubts.

    A coefficient that differs between groups moves in all of them alike. Doubts stand for the weights of a correction.
    """

    problem: Problem
    last: Step  # Where they are zero

    @cached_property
    def coefficients(self) -> list[int]:
        """Which of the chosen coefficients they are."""
        return [k for k, _ in self.problem.chosen.listed]

    @cached_property
    def directions(self) -> Array:
        """(d, w) one standard error of each doubt, in all weights of the correction."""
        rows = np.array(self.last.doubts).reshape(-1, len(FUNCTIONS), len(FUNCTIONS))[:, :DOUBTS]
        found = np.zeros((len(rows), DOUBTS, len(rows), len(FUNCTIONS)))
        for force, each in enumerate(rows):
            found[force, :, force] = each
        return found.reshape(len(rows) * DOUBTS, len(rows) * len(FUNCTIONS))

    @cached_property
    def carried(self) -> list[str]:
        """Names of those that each track has as coefficients of its own, in their order: all but the spins."""
        doubts = doubt_sigmas(self.problem.model) if len(self.directions) else ()
        return [name for _, name in self.problem.chosen.listed] + list(doubts)

    @property
    def of_carried(self) -> list[int]:
        """Which numbers they are."""
        first, doubts = len(self.coefficients), len(self.directions)
        return [*range(first), *range(self.size - doubts, self.size)]

    @property
    def scale(self) -> Array:
        """(c,) their standard errors."""
        return np.concatenate((np.array(self.last.sigma)[self.coefficients], np.ones(len(self.directions))))

    @property
    def spins(self) -> list[Index]:
        """(g,) numbers of the mean spins of all groups, along each axis."""
        first, groups = len(self.coefficients), len(self.last.spins)
        return [first + axis + 3 * np.arange(groups) for axis in range(3 if groups else 0)]

    @property
    def size(self) -> int:
        """How many they are."""
        return len(self.coefficients) + 3 * len(self.last.spins) + len(self.directions)

    @cached_property
    def stated(self) -> Array:
        """(p,) precisions that the model itself states, zero for those without a coefficient."""
        known = self.problem.model.declared_coefficients()
        sigmas = np.array([known[name].sigma for _, name in self.problem.chosen.listed])
        found = np.zeros(self.size)
        found[: len(sigmas)] = np.minimum(np.array(self.last.sigma)[self.coefficients] / sigmas, 1.0) ** 2
        return found

    def prior(self, precision: float) -> Array:
        """(p,) precisions about the most probable numbers, with some share of what the likelihood gives them."""
        return self.stated + precision * (1.0 - self.stated)

    def bounds(self) -> tuple[Array, Array]:
        """(p,) each."""
        chosen, k = self.problem.chosen, self.coefficients
        mean, sigma = np.array(self.last.mean)[k], np.array(self.last.sigma)[k]
        free = np.full(self.size - len(k), np.inf)
        return (
            np.concatenate(((chosen.low[k] - mean) / sigma, -free)),
            np.concatenate(((chosen.high[k] - mean) / sigma, free)),
        )

    def between(self, step: Step) -> Array:
        """(p,) those of another step; of its weights, what the doubts can say."""
        last, k, alike = self.last, self.coefficients, self.problem.chosen.alike
        mean = np.array(step.mean) - np.array(last.mean)
        spins = [
            (np.array(there.mean) - np.array(here.mean)) / np.array(here.sigma)
            for here, there in zip(last.spins, step.spins, strict=True)
        ]
        weights = np.linalg.lstsq(self.directions.T, mean[alike], rcond=None)[0] if len(alike) else np.zeros(0)
        return np.concatenate((mean[k] / np.array(last.sigma)[k], *spins, weights))

    def moved(self, step: Step, away: Array, factor: Array | None = None) -> Step:
        """A step with numbers that are moved by some (p,), and standard errors times some factors (p,)."""
        chosen, k = self.problem.chosen, self.coefficients
        first, last = len(k), len(k) + 3 * len(step.spins)
        factor = np.ones(self.size) if factor is None else factor
        mean, sigma, wide = np.array(step.mean), np.array(step.sigma), np.array(step.next_track)
        shift = np.zeros(len(mean))
        shift[k] = away[:first] * np.array(self.last.sigma)[k]
        if len(chosen.alike):
            shift[chosen.alike] = away[last:] @ self.directions
        by_group = {
            name: plain(np.clip(np.array(values) + shift[n], chosen.low[n], chosen.high[n]))
            for name, values in step.by_group.items()
            for n in [chosen.names.index(name)]
        }
        own = sigma[k] * factor[:first]
        wide[k] = np.sqrt(np.maximum(wide[k] ** 2 - sigma[k] ** 2, 0.0) + own**2)
        sigma[k] = own
        parts = zip(step.spins, self.last.spins, _threes(away[first:last]), _threes(factor[first:last]), strict=True)
        spins = tuple(there.moved(shift * np.array(here.sigma), more) for there, here, shift, more in parts)
        doubts = np.array(step.doubts).reshape(-1, len(FUNCTIONS), len(FUNCTIONS))
        doubts[:, :DOUBTS] *= factor[last:].reshape(-1, DOUBTS, 1)
        return step.model_copy(
            update={
                "doubts": tuple(plain(row) for row in doubts.reshape(-1, len(FUNCTIONS))),
                "mean": plain(np.clip(mean + shift, chosen.low, chosen.high)),
                "sigma": plain(sigma),
                "next_track": plain(wide),
                "by_group": by_group,
                "spins": spins,
            }
        )


def _threes(values: Array) -> Array:
    return values.reshape(-1, 3)


@dataclass(frozen=True)
class Predicted:
    """Predictions of the fitted tracks, linearised in the numbers: n predictions of e errors in all.

    Attributes:
        numbers: the p numbers.  errors: (e,) whitened.  slopes: (e, p).
        ends: (n + 1,) first errors of the predictions.  tracks: (n,) names of the tracks.  shares: observed of a track.
    """

    numbers: Numbers
    errors: Array
    slopes: Array
    ends: Index
    tracks: tuple[str, ...]
    shares: int

    @cached_property
    def grams(self) -> Array:
        """(n, p + 1, p + 1) sums of products of slopes and errors."""
        every = np.column_stack((self.slopes, self.errors))
        return np.array([every[a:b].T @ every[a:b] for a, b in pairwise(self.ends.tolist())])

    def weighed(self, away: Array, kept: Mask) -> Array:
        """(n, p + 1, p + 1) sums of products with the weights that the predictions have at some numbers (p,)."""
        far, sizes = np.append(away, 1.0), np.diff(self.ends)
        misses = np.sqrt(np.maximum(np.einsum("i,nij,j->n", far, self.grams, far), 0.0) / sizes)
        return (kept * weight(misses, sizes, self.shares))[:, None, None] * self.grams

    def fitted(self, precision: float, about: Array, kept: Mask) -> Array:
        """(p,) the numbers that predict best beside a prior about some. Args: kept: (n,) predictions that count."""
        if not np.isfinite(precision):
            return about
        away, prior, (low, high) = about, self.numbers.prior(precision), self.numbers.bounds()
        for _ in range(MOST_STEPS):
            sums = self.weighed(away, kept).sum(axis=0)
            own = sums[:-1, :-1] + np.diag(prior)
            away = np.clip(np.linalg.solve(own, prior * about - sums[:-1, -1]), low, high)
        return away

    def scores(self, away: Array, kept: Mask) -> dict[str, float]:
        """Mean log density of each track's predictions in whitened errors, at some numbers (p,)."""
        found: dict[str, list[float]] = {}
        for name, here, (a, b) in zip(self.tracks, kept.tolist(), pairwise(self.ends.tolist()), strict=True):
            if here:
                errors = self.errors[a:b] + self.slopes[a:b] @ away
                found.setdefault(name, []).append(float(log_density(errors, np.ones(1)).mean()))
        return {name: float(np.mean(each)) for name, each in found.items()}

    def covariance(self, precision: float, away: Array, kept: Mask) -> Array:
        """(p, p) of fitted numbers, by how the tracks scatter [P. Huber, 1967]; the prior's mean has a unit one."""
        weighed = self.weighed(away, kept)
        pulls = weighed[:, :-1, :-1] @ away + weighed[:, :-1, -1]
        names = sorted(set(self.tracks))
        of_track = np.array([pulls[[one == name for one in self.tracks]].sum(axis=0) for name in names])
        prior = np.diag(self.numbers.prior(precision))
        inverse = np.linalg.inv(weighed[:, :-1, :-1].sum(axis=0) + prior)
        return np.asarray(inverse @ (of_track.T @ of_track + prior**2) @ inverse)


def predicted(problem: Problem, last: Step, settings: Settings, watch: Watch = unwatched) -> Predicted:
    """The predictions of the fitted tracks from the `moments` of each to the config's horizon, linearised about a step.

    Over the next 0.3 s alone, coefficients of bounces stand for what the air lacks, and later predictions are worse.
    How a prediction follows the mean of a coefficient is told by its covariance with the track's own, whose prior the
    mean is. Mean spins are moved to see it: no covariance with the first spin is kept.

    Args: settings: with the step's population, and the noise that the tracks show.
    """
    numbers, groups = Numbers(problem, last), problem.groups
    tracks = list(tracks_of(problem.dataset, problem.split.fit))
    shares = moments(problem.config.observed_share)
    asked = Forecasts.of(
        partial(_estimator, numbers, settings), numbers.size, tracks, shares, problem.horizon, problem.jobs, watch
    )
    known = np.isfinite(asked.own)
    slopes = np.zeros((len(asked.own), numbers.size))
    columns = [list(settings.coefficients).index(name) for name in numbers.carried]
    width = np.array([settings.coefficients[name] for name in numbers.carried])
    if len(slopes):
        slopes[:, numbers.of_carried] = asked.carried[:, columns] / width**2 * numbers.scale
    spins = numbers.spins if groups is not None and len(groups.labelled) < len(tracks) else []
    probes = np.zeros((len(spins), numbers.size))
    for probe, axis in zip(probes, spins, strict=True):
        probe[axis] = DIFFERENCE  # in all groups at once: no track depends on the spins of two
    own = {name: 0 if groups is None else groups.names.index(groups.tracks[name]) for _, name in asked.parts}
    for axis, errors in zip(spins, asked.errors([*probes], watch) if len(probes) else (), strict=True):
        change = np.nan_to_num((errors - asked.own) / DIFFERENCE)
        for (_, name), part in asked.parts.items():
            slopes[part, axis[own[name]]] = change[part]
    parts = [(name, part) for (_, name), part in asked.parts.items() if known[part].all()]
    rows = np.concatenate([np.zeros(0, dtype=int), *(np.arange(part.start, part.stop) for _, part in parts)])
    ends = np.cumsum([0, *(part.stop - part.start for _, part in parts)])
    return Predicted(numbers, asked.own[rows], slopes[rows], ends, tuple(name for name, _ in parts), len(shares))


def _estimator(numbers: Numbers, settings: Settings, away: Array) -> Estimator:
    problem, step = numbers.problem, numbers.moved(numbers.last, away)
    if problem.groups is not None:
        settings = problem.groups.settings(settings, problem.groups.population(step.spins))
    return make_estimator("smoother", population_model(problem, step), problem.surfaces, settings)


def best_predicting(step: Step, made: Predicted, without: Collection[str] = ()) -> Step:
    """A step with the numbers that left-out tracks want: the most probable ones, or others that predict better.

    Args: step: that of the predictions, or one of fewer tracks.  without: names of tracks that have no part.
    """
    kept = np.array([name not in without for name in made.tracks], dtype=bool)
    names = list(dict.fromkeys(name for name, here in zip(made.tracks, kept.tolist(), strict=True) if here))
    if len(names) < LEAST:
        return step
    about = made.numbers.between(step)
    scores = [_left_out(made, precision, about, kept, names) for precision in PRECISIONS]
    best = int(np.argmax(scores))
    if best == 0:
        return step
    away = made.fitted(PRECISIONS[best], about, kept)
    factor = np.sqrt(np.diag(made.covariance(PRECISIONS[best], away, kept)))
    moved = made.numbers.moved(step, away - about, factor)
    return moved.model_copy(update={"predicting": scores[best] - scores[0]})


def _left_out(made: Predicted, precision: float, about: Array, kept: Mask, names: Sequence[str]) -> float:
    """Mean score of the tracks, each with the numbers of the other parts."""
    found: list[float] = []
    for part in range(min(FOLDS, len(names))):
        out = np.isin(made.tracks, names[part::FOLDS])
        found += made.scores(made.fitted(precision, about, kept & ~out), kept & out).values()
    return float(np.mean(found))


@dataclass(frozen=True)
class Finished:
    """A calibration as it is written.

    Attributes:
        step: the last one, with the means that predict best.  model: with them.
        settings: with the population.  noise: that the fitted tracks show; None if undetermined.
    """

    step: Step
    model: AnalyticModel
    settings: Settings
    noise: NoiseEstimate | None


def finished(problem: Problem, last: Step, watch: Watch = unwatched, *, errors: bool = True) -> Finished:
    """What the last step of a calibration gives; one camera's predictions have no depth, and leave its means.

    The noise is that about the most probable means: about those that were chosen to predict, it would be too small.

    Args: errors: as for `fitted_noise`.
    """
    model, settings = population_model(problem, last), population_settings(problem, last)
    noise = fitted_noise(problem, model, settings, watch, errors=errors)
    if noise is None or problem.dataset.one_view:
        return Finished(last, model, settings, noise)
    step = best_predicting(last, predicted(problem, last, noise.settings, watch))
    model, settings = population_model(problem, step), population_settings(problem, step)
    return Finished(step, model, settings, about_population(noise, settings))
