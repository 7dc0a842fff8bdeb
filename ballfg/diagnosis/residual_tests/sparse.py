"""Describes a pattern that no named effect explains by a few generic terms, if the model then predicts better.

They are chosen by forward selection with the extended BIC (J. Chen and Z. Chen 2008, gamma = 1).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.effects import has_effect
from ballfg.diagnosis.fit.fit import fit_problem
from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.hypotheses.signatures import hypothesis_signatures
from ballfg.diagnosis.result import Errors, Fallback
from ballfg.diagnosis.search.evaluation import errors_of, next_shot_model, noise_about
from ballfg.diagnosis.search.refits import with_hypothesis
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effects.registry import GENERIC

HELPS = 0.9  # Ratio of the prediction errors on the held-out half with and without an accepted fallback
MOST_TERMS = 12  # Largest number of terms; more describe noise, and are unreadable
LEAST_LEFT = 1e-6  # Least share of a term's information that is independent of the earlier terms


@dataclass(frozen=True)
class SparseTerms:
    """Generic effects with the chosen terms as strengths, and their one-step coefficients by parameter name.

    `explained` is the squared whitened residual that they would explain together.
    """

    hypotheses: tuple[Hypothesis, ...]
    estimates: Mapping[str, float]
    explained: float


def fallback(before: Fit, corrected: AnalyticModel, now: Errors, holdout: Holdout, jobs: int) -> Fallback | None:
    """A description of the rest without a name; None if nothing predicts better.

    Args: before: the fit to the search half.  corrected: its model, with noise.  now: errors on the held-out half.
    """
    terms = sparse_terms(before)
    if terms is None:
        return None
    after = fit_with_terms(before, terms)
    model = next_shot_model(after, holdout.launcher.embedding, corrected)
    model.noise = noise_about(model, holdout.search_tracks, holdout.dataset, corrected.noise, jobs=jobs)
    errors = errors_of(model, holdout, holdout.held_out_tracks, jobs)
    if errors.prediction_rmse_mm >= HELPS * now.prediction_rmse_mm:
        return None
    return Fallback("sparse terms", describe(terms, after), now, errors, model)


def describe(terms: SparseTerms, after: Fit) -> str:
    """The terms with their fitted coefficients, sorted by explained residual."""
    units = after.problem.model.declared_coefficients()
    values = {name: after.unknowns.values[name] for name in terms.estimates}
    return ", ".join(f"{name.split('.', 1)[1]} = {value:.3g} {units[name].unit}" for name, value in values.items())


def sparse_terms(before: Fit) -> SparseTerms | None:
    """The generic terms that a fit lacks; None if none exceeds its penalty."""
    library = _library(before)
    found, _ = hypothesis_signatures(before, library)
    efficient = found.efficient()
    loose = np.concatenate([[c.sigma for c in h.free().values()] for h in library])
    information = efficient.total + np.diag(loose**-2.0)
    score = efficient.score.sum(axis=0)
    samples = 3 * int(before.problem.stretches.used.sum())
    chosen = select(information, score, np.log(samples) + 2.0 * np.log(len(score)))
    if not chosen:
        return None
    estimate = np.linalg.solve(information[np.ix_(chosen, chosen)], score[chosen])
    names = [name for h in library for name in h.columns]
    taken = {names[i] for i in chosen}
    kept = [replace(h, strengths=tuple(s for s in h.strengths if h.parameter(s) in taken)) for h in library]
    estimates = {names[i]: float(e) for i, e in zip(chosen, estimate, strict=True)}
    return SparseTerms(tuple(h for h in kept if h.strengths), estimates, float(estimate @ score[chosen]))


def fit_with_terms(before: Fit, terms: SparseTerms) -> Fit:
    """The joint fit with the terms in the model, at the noise of the previous fit."""
    problem = before.problem
    for hypothesis in terms.hypotheses:
        problem = with_hypothesis(problem, hypothesis)
    listed = problem.free
    start = {n: float(np.clip(v, listed[n].low, listed[n].high)) for n, v in terms.estimates.items()}
    unknowns = replace(before.unknowns, values={**before.unknowns.values, **start})
    return fit_problem(problem, unknowns, before.noise, settle_noise=False)


def select(information: Array, score: Array, penalty: float) -> list[int]:
    """Indices of the terms above their penalty, in the order of choice, from information (p, p) and score (p,).

    Args: penalty: least gain of a term, as twice a log likelihood.
    """
    chosen: list[int] = []
    while len(chosen) < MOST_TERMS:
        across = information[:, chosen]
        solved = np.linalg.solve(information[np.ix_(chosen, chosen)], across.T) if chosen else np.zeros((0, len(score)))
        left = score - solved.T @ score[chosen]
        own = np.diagonal(information) - (across * solved.T).sum(axis=1)
        seen = own > LEAST_LEFT * np.diagonal(information)
        gain = np.where(seen, left**2 / np.where(seen, own, 1.0), 0.0)  # of each further term beside the chosen ones
        best = int(np.argmax(gain))
        if gain[best] < penalty:
            break
        chosen.append(best)
    while chosen:  # drop terms that the others nearly replace
        inverse = np.linalg.inv(information[np.ix_(chosen, chosen)])
        loss = (inverse @ score[chosen]) ** 2 / np.diagonal(inverse)
        least = int(np.argmin(loss))
        if loss[least] >= penalty:
            break
        del chosen[least]
    return chosen


def _library(before: Fit) -> list[Hypothesis]:
    """All generic terms about the middle of the data; those of contacts only if there are contacts."""
    stretches = before.problem.stretches
    positions = stretches.positions.numpy()[stretches.used.numpy()]
    middle = dict(zip(("center_x", "center_y", "center_z"), np.median(positions, axis=0).tolist(), strict=True))
    bounces, listed = bool(stretches.heights.isfinite().any()), []
    for effect in GENERIC.values():
        if (effect.kind != "bounce" or bounces) and not has_effect(before.problem.model, effect.name):
            shape = {c.name: middle[c.name] for c in effect.coefficients if c.name in middle}
            strengths = tuple(c.name for c in effect.coefficients if c.absent is not None)
            listed.append(Hypothesis(effect, shape, strengths))
    return listed
