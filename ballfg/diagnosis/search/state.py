"""Holds the state of a search: its model, fit and errors, and the named and refused effects."""

from dataclasses import dataclass, field, replace

from ballfg.diagnosis.fit.fit import fit_problem
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Candidate, Errors, Finding, Refusal
from ballfg.diagnosis.search.candidates import Refit
from ballfg.diagnosis.search.evaluation import HeldOutGain
from ballfg.diagnosis.search.hypothesis import Hypothesis, has_effect, without_effect
from ballfg.diagnosis.search.process_noise import PredictiveModel


@dataclass(frozen=True)
class Search:
    """State of the search after some rounds.

    Attributes:
        first, declared: fit of the declared model, and that model for predictions.
        fit, predictive: the same of the model with the effects added so far.
        before, judged: prediction errors of both on the judging half.
        whole: the last model fitted to the tracks of both halves, at the end of the search, for the report.
        named: the effects added so far, in order.
        findings, rounds: as in `Diagnosis`.
        refused: refused effects that fit better, by name.
    """

    first: Fit
    declared: PredictiveModel
    fit: Fit
    predictive: PredictiveModel
    before: Errors
    judged: Errors
    whole: Fit
    named: tuple[Hypothesis, ...] = ()
    findings: tuple[Finding, ...] = ()
    rounds: tuple[tuple[Candidate, ...], ...] = ()
    refused: dict[str, Refusal] = field(default_factory=dict)


@dataclass(frozen=True)
class Confirmed:
    """A refit that deserves a name.

    Attributes:
        refit: with the effect.
        evidence: its gain on the held-out half.
        kept: earlier effects that stay.
        settled, predictive: the fit with converged noise, and its model for predictions.
        whole: the same model fitted to the tracks of both halves.
        judged: errors of its predictions on the judging half.
    """

    refit: Refit
    evidence: HeldOutGain
    kept: tuple[Hypothesis, ...]
    settled: Fit
    whole: Fit
    predictive: PredictiveModel
    judged: Errors


def left_out(
    search: Search, hypothesis: Hypothesis, fit: Fit, predictive: PredictiveModel, judged: Errors, refusal: Refusal
) -> Search:
    """The search without one of its effects, with the corresponding fit and errors."""
    kept = [h for h in search.named if h is not hypothesis and has_effect(fit.problem.model, h.effect.name)]
    return replace(
        search,
        fit=fit,
        predictive=predictive,
        judged=judged,
        named=tuple(kept),
        findings=tuple(f for f in search.findings if f.name in {h.name for h in kept}),
        refused=search.refused | {hypothesis.name: refusal},
    )


def without_named(fit: Fit, hypothesis: Hypothesis, first: Fit) -> Fit:
    """The fit without one of the effects added to the first one's model, at the same noise."""
    problem, name = fit.problem, hypothesis.effect.name
    gone = set(hypothesis.columns)
    needed = has_effect(first.problem.model, name)
    if hypothesis.deviations():  # the effect itself may have been named too, the same for all tracks
        needed |= any(n.startswith(f"{hypothesis.effect.kind}.{name}.") for n in problem.free if n not in gone)
    model = problem.model if needed else without_effect(problem.model, name)
    left = dict(model.named_parameters())
    deviations = {n: d for n, d in problem.deviations.items() if d.coefficient in left and n not in gone}
    free = {n: c for n, c in problem.free.items() if (n in left or n in deviations) and n not in gone}
    unknowns = replace(fit.unknowns, values={n: fit.unknowns.values[n] for n in free})
    problem = replace(problem, model=model, free=free, deviations=deviations)
    return fit_problem(problem, unknowns, fit.noise, settle_noise=False)
