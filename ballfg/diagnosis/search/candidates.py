"""One round of the search: score every hypothesis, refit the leading ones, choose by what the refit says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats

from ballfg.diagnosis.fit.columns import signatures
from ballfg.diagnosis.fit.fit import fit
from ballfg.diagnosis.fit.label_frames import FRAMES
from ballfg.diagnosis.fit.problem import Fit, Problem, linearise
from ballfg.diagnosis.search.hypothesis import Hypothesis, with_effects
from ballfg.diagnosis.search.score import Score, score_tests
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.state import SPIN

Array = NDArray[np.float64]

ALARM = 0.05
"""Probability that a hypothesis passes the score tests of one round by chance. It must then also help on the judging
half (`loop.CONFIRMED`), so that both together happen by chance in one round of 400."""
MOST_REFITS = 6
"""Hypotheses that are refitted in a round."""
SEARCHED = 2.0 * float(np.log(FRAMES - 1))
"""What a label frame costs in BIC: it was chosen among so many others."""
LEADING = 0.5
"""A hypothesis that explains less than this share of the best one's is not refitted."""


@dataclass(frozen=True)
class Scored:
    """A hypothesis and the outcome of its score test, corrected for the number of hypotheses; None: not visible."""

    hypothesis: Hypothesis
    score: Score | None
    p_value: float


@dataclass(frozen=True)
class Refit:
    """A hypothesis in the model, everything fitted again.

    Attributes:
        scored: what called for it.
        fit: the minimum, at the noise of the fit before.
        delta_bic: BIC minus that of the fit before; negative is better.
    """

    scored: Scored
    fit: Fit
    delta_bic: float


def score_all(before: Fit, candidates: Sequence[Hypothesis]) -> list[Scored]:
    """Score tests of all hypotheses, the one that explains most first; invisible ones last."""
    testable = [h for h in candidates if h.strengths]
    if not testable:
        return []
    found, chosen = signatures(before, testable)
    scored = []
    for hypothesis, score in zip(testable, score_tests(found, chosen), strict=True):
        p_value = 1.0 if score is None else min(1.0, score.p_value * len(testable))
        scored.append(Scored(hypothesis, score, p_value))
    return sorted(scored, key=explained, reverse=True)


def explained(scored: Scored) -> float:
    """Squared whitened residual that a hypothesis would explain; below zero where it cannot be seen."""
    return -1.0 if scored.score is None else scored.score.explained


def shortlist(scored: Sequence[Scored]) -> list[Scored]:
    """The hypotheses to refit: significant, the best shape of each effect, not far behind the first."""
    best: dict[str, Scored] = {}
    for candidate in scored:
        if candidate.score is not None and candidate.p_value < ALARM:
            best.setdefault(candidate.hypothesis.name, candidate)
    listed = list(best.values())[:MOST_REFITS]
    first = listed[0].score if listed else None
    return [s for s in listed if s.score and first and s.score.explained >= LEADING * first.explained]


def refit(before: Fit, scored: Scored) -> Refit:
    """The joint fit with a hypothesis in the model, from where it is absent: the first step goes where its score says.

    An effect that balls usually have (friction, say) is also started at its usual strength, for its absence may be a
    minimum of its own: without friction, spins are fitted that friction contradicts.
    """
    hypothesis, problem = scored.hypothesis, with_hypothesis(before.problem, scored.hypothesis)
    parameters = dict(problem.model.named_parameters())
    absent = {name: float(parameters[name]) for name in hypothesis.free()}
    listed = {hypothesis.parameter(c.name): c.default for c in hypothesis.effect.coefficients}
    usual = {name: listed[name] if name in hypothesis.columns else value for name, value in absent.items()}
    tried = [
        _from(before, hypothesis, problem, values) for values in ([absent] if usual == absent else [absent, usual])
    ]
    after = min(tried, key=lambda fitted: fitted.cost)
    chosen = 0.0 if hypothesis.strengths else SEARCHED
    return Refit(scored, after, delta_bic(before, after) + chosen)


def _from(before: Fit, hypothesis: Hypothesis, problem: Problem, values: Mapping[str, float]) -> Fit:
    """The fit of a problem with a hypothesis in it, started where the fit before ended, and at some values of it."""
    unknowns = replace(before.unknowns, values={**before.unknowns.values, **values})
    if hypothesis.shape and not hypothesis.strengths:
        unknowns = replace(unknowns, starts=_starts_with_labels(problem, unknowns.starts))
    return fit(problem, unknowns, before.noise, settle_noise=False)


def with_hypothesis(problem: Problem, hypothesis: Hypothesis) -> Problem:
    """The problem with an effect in its model and the effect's coefficients free."""
    assert isinstance(problem.model, AnalyticModel)
    return replace(problem, model=hypothesis.added_to(problem.model), free={**problem.free, **hypothesis.free()})


def _starts_with_labels(problem: Problem, starts: Array) -> Array:
    """First states whose spins are what the labels mean to a model that reads them in another frame."""
    with torch.no_grad():
        offset = problem.model.labelled(torch.zeros(3, dtype=torch.float64)).numpy()
        read = problem.model.labelled(torch.eye(3, dtype=torch.float64)).numpy() - offset  # rows M e_i
    labelled, moved = problem.stretches.labelled, starts.copy()
    moved[labelled, SPIN] = (problem.stretches.labels.numpy()[labelled] - offset) @ np.linalg.inv(read)
    return moved


def refit_driven(before: Fit, hypothesis: Hypothesis) -> Refit:
    """The fit with an effect that multiplies spins nobody labelled.

    A coefficient times a spin of mean zero has no slope at zero. With the coefficient at its usual value the spins
    have one: launcher settings and single shots find theirs, and the ratio of marginal likelihoods is the test. They
    find theirs first, at that value: spins that only bounces had told may have the wrong sign, and the coefficient
    would take it over.
    """
    assert isinstance(before.problem.model, AnalyticModel)
    listed = {hypothesis.parameter(c.name): c for c in hypothesis.effect.coefficients}
    free = {**before.problem.free, **{name: listed[name] for name in hypothesis.columns}}
    model = with_effects(before.problem.model, hypothesis.effect())
    problem = replace(before.problem, model=model, free=free)
    usual = fit(replace(problem, free=before.problem.free), before.unknowns, before.noise, settle_noise=False)
    values = {name: c.default for name, c in listed.items()}
    unknowns = replace(usual.unknowns, values={**usual.unknowns.values, **values})
    after = fit(problem, unknowns, before.noise, settle_noise=False)
    taken = 2.0 * (_narrowness(after) - _narrowness(before))
    freedom = 3 * problem.stretches.settings.shape[1] + len(hypothesis.columns)
    return _by_likelihood(before, after, hypothesis, taken, freedom)


def refit_usual(before: Fit, hypothesis: Hypothesis) -> Refit:
    """The fit with an effect that balls usually have, whatever its score says.

    From its absence to its usual strength is a long way, on which a slope at absence may say nothing: without friction
    a ball keeps its spin through a bounce, and nothing tells what friction would do to the spin that was fitted to it.
    """
    after = refit(before, Scored(hypothesis, None, 1.0)).fit
    return _by_likelihood(before, after, hypothesis, 0.0, len(hypothesis.columns))


def _by_likelihood(before: Fit, after: Fit, hypothesis: Hypothesis, taken: float, freedom: int) -> Refit:
    """A refit that its likelihood ratio judges, less what is `taken` for spins that became free."""
    gain = 2.0 * (before.cost - after.cost) - taken
    estimate = np.array([after.unknowns.values[name] for name in hypothesis.columns])
    p_value = float(stats.chi2.sf(max(gain, 0.0), freedom))
    score = Score(estimate, np.full(len(estimate), np.nan), gain, p_value, freedom)
    return Refit(Scored(hypothesis, score, score.p_value), after, delta_bic(before, after) + taken)


def _narrowness(fitted: Fit) -> float:
    """Half the log determinant of what is known of first states: with the cost their Laplace marginal likelihood.

    With a lift every spin is a degree of freedom of its flight, which fits noise too; this is what that costs.
    """
    by_start = linearise(fitted.problem, fitted.unknowns, fitted.noise, fitted.predicted).by_start
    return 0.5 * float(np.linalg.slogdet(by_start.swapaxes(-1, -2) @ by_start)[1].sum())


def delta_bic(before: Fit, after: Fit) -> float:
    """BIC of one fit minus that of another at the same noise; what is counted are tracks, the independent units."""
    more = len(after.problem.free) - len(before.problem.free)
    tracks = len(np.unique(before.problem.stretches.track))
    return 2.0 * (after.cost - before.cost) + more * float(np.log(tracks))
