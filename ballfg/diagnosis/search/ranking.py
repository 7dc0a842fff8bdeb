"""Reports a search round in words and numbers: the added effect, and the ranking of all candidates."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.diagnosis.fit.fit import covariance_of, values_of
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Candidate, Finding, Outcome, Value
from ballfg.diagnosis.search.candidates import ALARM, Refit, Scored
from ballfg.diagnosis.search.evaluation import HeldOutGain
from ballfg.diagnosis.search.hypothesis import TWINS, Hypothesis
from ballfg.diagnosis.search.parsimony import significance

NO_NAME: Final = (
    Outcome.IMPLAUSIBLE,
    Outcome.INSIGNIFICANT,
    Outcome.CONTRADICTORY,
    Outcome.SAME_PATTERN,
    Outcome.MISLEADING,
)
"""Outcomes of refused candidates that fit better on both halves: the report gives the reason."""


def finding_of(refit: Refit, settled: Fit, evidence: HeldOutGain, alike: tuple[str, ...]) -> Finding:
    """An added effect, with its evidence. settled: the fit with it and a new noise estimate."""
    hypothesis = refit.scored.hypothesis
    return Finding(
        name=hypothesis.name,
        kind=hypothesis.effect.kind,
        sentence=hypothesis.sentence,
        decide=hypothesis.decide,
        parameters=fitted_values(settled, hypothesis),
        p_value=refit.scored.p_value,
        delta_bic=refit.delta_bic,
        indistinguishable_from=(*TWINS.get(hypothesis.name, ()), *alike),
        held_out_gain=evidence.gain,
        held_out_p=evidence.p_value,
    )


def fitted_values(fit: Fit, hypothesis: Hypothesis) -> dict[str, Value]:
    """The fitted coefficients of an effect, and the fixed ones of its shape."""
    names = {hypothesis.parameter(name): name for name in hypothesis.coefficients}
    values = values_of(fit, [name for name in names if name in fit.problem.free], {})
    return hypothesis.reported(fit, {names[name]: value for name, value in values.items()})


def as_left(findings: Sequence[Finding], named: Sequence[Hypothesis], fit: Fit, first: Fit) -> tuple[Finding, ...]:
    """Findings with the coefficients of the last fit, with all the others in the model.

    The standard deviation of a strength is that of its significance; first: the fit without any of the findings. An
    effect that turned out to differ between tracks is listed only in that form.
    """
    refreshed = []
    varying = {h.effect.name for h in named if h.deviations()}
    for finding, hypothesis in zip(findings, named, strict=True):
        if not hypothesis.deviations() and hypothesis.effect.name in varying:
            continue
        values = fitted_values(fit, hypothesis)
        sigmas = significance(fit, hypothesis, first).sigmas if hypothesis.strengths else np.zeros(0)
        if hypothesis.deviations():  # the report gives the sum with the coefficient itself
            noise = np.sqrt(np.diagonal(covariance_of(fit, hypothesis.columns)))
            sigmas = sigmas / noise * [values[name].sigma for name in hypothesis.strengths]
        for name, sigma in zip(hypothesis.strengths, sigmas.tolist(), strict=True):
            if np.isfinite(sigma):
                values[name] = replace(values[name], sigma=sigma)
        refreshed.append(replace(finding, parameters=values))
    return tuple(refreshed)


def ranking(
    scored: Sequence[Scored], refits: Sequence[Refit], outcomes: Mapping[str, Outcome]
) -> tuple[Candidate, ...]:
    """One row per effect in its best shape, sorted by explained residual."""
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
    least = dict(zip(estimate, score.seen_from(ALARM / scored.tested).tolist(), strict=True))
    if outcome is None and delta_bic is not None:
        outcome = Outcome.WEAKER
    if outcome is None:
        hidden = all(s > c.sigma > 0.0 for c, s in zip(listed, score.sigma, strict=True))
        outcome = Outcome.INVISIBLE if hidden else Outcome.NOT_NEEDED
    return Candidate(hypothesis.name, kind, estimate, score.explained, scored.p_value, delta_bic, outcome, least)
