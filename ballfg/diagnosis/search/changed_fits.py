"""Fits again with fewer effects among the named ones, or with effects as strong as another model says."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ballfg.diagnosis.evidence.weighed import Weighed
from ballfg.diagnosis.fit.fit import fit_problem
from ballfg.diagnosis.fit.problem import Fit, Problem
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis, has_effect, with_coefficients, without_effect
from ballfg.diagnosis.search.candidates import FIRST_STEPS


def with_strengths_of(model: Weighed, fit: Fit) -> Fit:
    """A fit without patterns, its named effects as strong as in the model beside them.

    Free, they would make up for what no effect describes. Effects that differ between tracks stay free.
    """
    known, problem = model.fit.unknowns.values, fit.problem
    held = {c: known[c] for h in model.named if not h.deviations() for c in h.columns if c in problem.free}
    free = {name: c for name, c in problem.free.items() if name not in held}
    values = {name: value for name, value in fit.unknowns.values.items() if name in free}
    problem = replace(problem, model=with_coefficients(problem.model, held), free=free)
    fitted = fit_problem(problem, replace(fit.unknowns, values=values), fit.noise)
    return fitted if np.isfinite(fitted.cost) else fit


def without_named(fit: Fit, gone: Sequence[Hypothesis], first: Fit) -> Fit:
    """A few steps of the fit without some of the effects added to the first one's model, at the same noise.

    They begin at the first one's values where a ball leaves its path without an effect: a large lift that saturates
    without its saturation, say.
    """
    problem = fit.problem
    for hypothesis in gone:
        problem = _problem_without(problem, hypothesis, first)
    known, plain = fit.unknowns, first.unknowns
    kept = replace(known, values={n: known.values[n] for n in problem.free})
    begun = fit_problem(problem, kept, fit.noise, settle_noise=False, steps=FIRST_STEPS)
    if np.isfinite(begun.cost):
        return begun
    values = {n: plain.values.get(n, value) for n, value in kept.values.items()}
    return fit_problem(problem, replace(plain, values=values), fit.noise, settle_noise=False, steps=FIRST_STEPS)


def _problem_without(problem: Problem, hypothesis: Hypothesis, first: Fit) -> Problem:
    """The problem without an effect that the first fit's model lacks, or without its free coefficients."""
    name, gone = hypothesis.effect.name, set(hypothesis.columns)
    needed = has_effect(first.problem.model, name)
    if hypothesis.deviations():  # the effect itself may have been named too, the same for all tracks
        needed |= any(n.startswith(f"{hypothesis.effect.kind}.{name}.") for n in problem.free if n not in gone)
    model = problem.model if needed else without_effect(problem.model, name)
    left = dict(model.named_parameters())
    deviations = {n: d for n, d in problem.deviations.items() if d.coefficient in left and n not in gone}
    free = {n: c for n, c in problem.free.items() if (n in left or n in deviations) and n not in gone}
    return replace(problem, model=model, free=free, deviations=deviations)
