"""One round of the search in words and numbers: the effect that was added, and the ranking of all candidates."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from ballfg.diagnosis.fit.fit import values_of
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Candidate, Finding, Outcome, Value
from ballfg.diagnosis.search.candidates import Refit, Scored
from ballfg.diagnosis.search.evaluation import HeldOutGain
from ballfg.diagnosis.search.hypothesis import TWINS, Hypothesis
from ballfg.diagnosis.search.parsimony import own_scores

NO_NAME: Final = (
    Outcome.IMPLAUSIBLE,
    Outcome.INSIGNIFICANT,
    Outcome.CONTRADICTORY,
    Outcome.SAME_PATTERN,
    Outcome.MISLEADING,
)
"""Outcomes of candidates that fit better on both halves and are no names all the same: the report says why."""


def finding_of(refit: Refit, settled: Fit, evidence: HeldOutGain, alike: tuple[str, ...]) -> Finding:
    """An effect that is added, with its evidence. settled: the fit with it, its noise estimated anew."""
    hypothesis = refit.scored.hypothesis
    return Finding(
        name=hypothesis.name,
        kind=hypothesis.effect.kind,
        sentence=hypothesis.effect.sentence,
        decide=hypothesis.effect.decide,
        parameters=fitted_values(settled, hypothesis),
        p_value=refit.scored.p_value,
        delta_bic=refit.delta_bic,
        indistinguishable_from=(*TWINS.get(hypothesis.name, ()), *alike),
        held_out_gain=evidence.gain,
        held_out_p=evidence.p_value,
    )


def fitted_values(fit: Fit, hypothesis: Hypothesis) -> dict[str, Value]:
    """Coefficients of an effect as fitted, and those of its shape that were not."""
    names = {hypothesis.parameter(name): name for name in hypothesis.coefficients}
    values = {names[n]: v for n, v in values_of(fit, [n for n in names if n in fit.problem.free], {}).items()}
    shape = {c: v for c, v in hypothesis.shape.items() if c not in values}
    return values | {c: Value(v, 0.0, hypothesis.coefficients[c].unit) for c, v in shape.items()}


def as_left(findings: Sequence[Finding], named: Sequence[Hypothesis], fit: Fit) -> tuple[Finding, ...]:
    """Findings with the coefficients of the last fit, beside all the others.

    The standard deviation of a strength is that of the noise or that of the scatter of tracks, the larger of the two.
    """
    refreshed = []
    for finding, hypothesis in zip(findings, named, strict=True):
        values = fitted_values(fit, hypothesis)
        (score,) = own_scores(fit, [hypothesis]) if hypothesis.strengths else [None]
        for name, sigma in zip(hypothesis.strengths, () if score is None else score.sigma.tolist(), strict=False):
            values[name] = replace(values[name], sigma=max(values[name].sigma, sigma))
        refreshed.append(replace(finding, parameters=values))
    return tuple(refreshed)


def ranking(
    scored: Sequence[Scored], refits: Sequence[Refit], outcomes: Mapping[str, Outcome]
) -> tuple[Candidate, ...]:
    """One row an effect, its best shape, the one that explains most first."""
    refitted = {r.name: r.delta_bic for r in refits}
    best: dict[str, Scored] = {}
    for candidate in scored:
        best.setdefault(candidate.hypothesis.name, candidate)
    return tuple(_row(s, refitted.get(n), outcomes.get(n)) for n, s in best.items())


def _row(scored: Scored, delta_bic: float | None, outcome: Outcome | None) -> Candidate:
    hypothesis, score, kind = scored.hypothesis, scored.score, scored.hypothesis.effect.kind
    if score is None:
        return Candidate(hypothesis.name, kind, {}, 0.0, 1.0, None, Outcome.INVISIBLE)
    listed = [hypothesis.coefficients[n] for n in hypothesis.strengths]
    estimate = {
        c.name: Value(float(v), float(s), c.unit) for c, v, s in zip(listed, score.estimate, score.sigma, strict=True)
    }
    if outcome is None and delta_bic is not None:
        outcome = Outcome.WEAKER
    if outcome is None:
        hidden = all(s > c.sigma > 0.0 for c, s in zip(listed, score.sigma, strict=True))
        outcome = Outcome.INVISIBLE if hidden else Outcome.NOT_NEEDED
    return Candidate(hypothesis.name, kind, estimate, score.explained, scored.p_value, delta_bic, outcome)
