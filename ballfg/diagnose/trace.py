"""One round of the search: score every hypothesis, refit the leading ones, choose by what the refit says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ballfg.diagnose.columns import signatures
from ballfg.diagnose.fit import Fit, fit
from ballfg.diagnose.hypothesis import Hypothesis
from ballfg.diagnose.score import Score
from ballfg.dynamics.analytic import AnalyticModel

Array = NDArray[np.float64]

ALARM = 0.01
"""Probability of naming an effect where there is none, for one round on the finding half alone."""
MOST_REFITS = 6
"""Hypotheses that are refitted in a round."""
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
    efficient = found.efficient()
    dispersion = efficient.dispersion(chosen)
    scored = []
    for hypothesis, columns in zip(testable, chosen, strict=True):
        score = efficient.test(columns, dispersion)
        p_value = 1.0 if score is None else min(1.0, score.p_value * len(testable))
        scored.append(Scored(hypothesis, score, p_value))
    return sorted(scored, key=lambda s: -1.0 if s.score is None else -s.score.explained)


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
    """The joint fit with a hypothesis in the model, from where its score points."""
    hypothesis = scored.hypothesis
    assert isinstance(before.problem.model, AnalyticModel) and scored.score is not None
    model = hypothesis.added_to(before.problem.model)
    problem = replace(before.problem, model=model, free={**before.problem.free, **hypothesis.free()})
    parameters = dict(model.named_parameters())
    values = {name: float(parameters[name]) for name in hypothesis.free()}
    for name, step in zip(hypothesis.columns, scored.score.estimate, strict=True):
        coefficient = problem.free[name]
        values[name] = float(np.clip(values[name] + step, coefficient.low, coefficient.high))
    unknowns = replace(before.unknowns, values={**before.unknowns.values, **values})
    after = fit(problem, unknowns, before.noise, settle_noise=False)
    return Refit(scored, after, delta_bic(before, after))


def delta_bic(before: Fit, after: Fit) -> float:
    """BIC of one fit minus that of another at the same noise; the samples are coordinates."""
    more = len(after.problem.free) - len(before.problem.free)
    samples = 3 * int(before.problem.stretches.used.sum())
    return 2.0 * (after.cost - before.cost) + more * float(np.log(samples))


