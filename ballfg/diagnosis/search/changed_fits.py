"""Fits again with fewer effects among the named ones, or with effects as strong as another model says."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ballfg.arrays import Mask
from ballfg.diagnosis.evidence.prior import centres
from ballfg.diagnosis.evidence.rows import Motion
from ballfg.diagnosis.evidence.sets import Sets
from ballfg.diagnosis.evidence.weighed import WORTH_A_STEP, Weighed, weighed
from ballfg.diagnosis.fit.fit import fit_problem, followed
from ballfg.diagnosis.fit.problem import Fit, Problem
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis, has_effect, with_coefficients, without_effect
from ballfg.diagnosis.search.candidates import Scored
from ballfg.diagnosis.search.refits import FIRST_STEPS, refit_set


def with_strengths_of(model: Weighed, fit: Fit) -> Fit:
    """A fit without patterns, its named effects as strong as in the model beside them.

    Free, they would make up for what no effect describes. Effects that differ between tracks stay free.
    """
    fixed = [h for h in model.named if not h.deviations()]
    known = {c: float(v) for h in fixed for c, v in zip(h.columns, model.strengths[h.name].mean, strict=True)}
    bounds = fit.problem.free
    known = {c: float(np.clip(v, bounds[c].low, bounds[c].high)) for c, v in known.items() if c in bounds}
    held = _held(fit, known | {c: v for c, v in _shapes(model.fit, fixed).items() if c in bounds})
    fitted = fit_problem(held.problem, held.unknowns, fit.noise)
    return fitted if np.isfinite(fitted.cost) else fit


def _shapes(fit: Fit, named: Sequence[Hypothesis]) -> dict[str, float]:
    """The coefficients of the forms of effects (centres, sizes), about which their strengths are linearised."""
    values = fit.unknowns.values
    return {c: values[c] for h in named for c in h.free() if c not in h.columns and c in values}


def _held(fit: Fit, values: Mapping[str, float]) -> Fit:
    """The fit with some coefficients at these values, and no longer free."""
    free = {name: c for name, c in fit.problem.free.items() if name not in values}
    problem = replace(fit.problem, model=with_coefficients(fit.problem.model, values), free=free)
    known = {name: value for name, value in fit.unknowns.values.items() if name in free}
    return Fit.at(problem, replace(fit.unknowns, values=known), fit.noise)


def model_of(sets: Sets, names: frozenset[str], first: Fit) -> Weighed:
    """The model of a set of effects beside patterns: strengths as the set has them, and a fit without patterns.

    Args: first: as of `without_named`.
    """
    member, model = sets.members[names], sets.screen.model
    gone, added = sets.listed(names)
    strengths = sets.screen.strengths(member.beside, member.gone)
    fit = without_at_shapes(model, gone, first) if gone else model.fit
    if added:
        away = [strengths[h.name].mean - centres(h, model.fit.problem.model) for h in added]
        still = np.zeros(len(fit.problem.common_precision))
        fit = refit_set(fit, [Scored(h, None, 1.0) for h in added], still, np.concatenate(away)).fit
    effects = len(sets.screen.effects)
    widths = [width for place, width in enumerate(model.widths[:effects]) if place not in member.gone]
    return Weighed(
        member.weight.evidence,
        member.weight.odds,
        member.weight.held_out,
        member.weight.prior,
        (*(h for h in model.named if h not in gone), *added),
        fit,
        model.noise,
        model.weights,
        (*widths, *(width for _, width in member.beside), *model.widths[effects:]),
        strengths,
        model.halves,
        nameless=True,
    )


def without_at_shapes(model: Weighed, gone: Sequence[Hypothesis], first: Fit) -> Fit:
    """The fit without some effects; those that stay keep their forms, about which their strengths are known.

    Free, the form of an effect that the fit has at hardly any strength would wander out of the room.
    """
    free = model.fit.problem.free
    shapes = _shapes(model.fit, [h for h in model.named if not h.deviations()])
    fit = without_named(_held(model.fit, shapes), gone, first)
    left = dict(fit.problem.model.named_parameters())
    shapes = {name: value for name, value in shapes.items() if name in left}
    problem = replace(fit.problem, free={n: c for n, c in free.items() if n in fit.problem.free or n in shapes})
    return Fit.at(problem, replace(fit.unknowns, values=fit.unknowns.values | shapes), fit.noise)


def smaller_fit(model: Weighed, gone: Sequence[Hypothesis], first: Fit) -> Fit:
    """The fit without some of a model's effects, where its linearisation says that the other unknowns then go.

    Steps of the deterministic fit would lead away from where random motion makes the unknowns most probable.

    Args: first: as of `without_named`.
    """
    fit, smaller = model.fit, model.nested.get(model.names - {h.name for h in gone})
    if smaller is not None:  # its step goes on to patterns, which are no unknowns of the fit
        known = followed(fit, fit.stepped(smaller.step[: len(fit.problem.common_precision)])).unknowns
        problem = _problem_without(fit.problem, gone, first)
        kept = replace(known, values={name: known.values[name] for name in problem.free})
        found = Fit.at(problem, kept, fit.noise)
        if np.isfinite(found.cost):
            return found
    return without_named(fit, gone, first)


def weighed_without(model: Weighed, gone: Sequence[Hypothesis], first: Fit, motion: Motion, halves: Mask) -> Weighed:
    """A model without some of its effects, from where `smaller_fit` leads.  Args: as of `smaller_fit`, `weighed`.

    Where that is a poorer minimum than the linearisation foretells, steps of the fit may lead to a better one.
    """
    kept = [h for h in model.named if h not in gone]
    found = weighed(smaller_fit(model, gone, first), kept, motion, halves, model)
    foretold = model.nested.get(model.names - {h.name for h in gone})
    if foretold is None or found.score > foretold.score - WORTH_A_STEP:
        return found
    other = without_named(model.fit, gone, first)
    if not np.isfinite(other.cost):
        return found
    return max(found, weighed(other, kept, motion, halves, model), key=lambda one: one.score)


def without_named(fit: Fit, gone: Sequence[Hypothesis], first: Fit) -> Fit:
    """A few steps of the fit without some of the effects added to the first one's model, at the same noise.

    They begin at the first one's values where a ball leaves its path without an effect: a large lift that saturates
    without its saturation, say.
    """
    problem = _problem_without(fit.problem, gone, first)
    known, plain = fit.unknowns, first.unknowns
    kept = replace(known, values={n: known.values[n] for n in problem.free})
    begun = fit_problem(problem, kept, fit.noise, settle_noise=False, steps=FIRST_STEPS)
    if np.isfinite(begun.cost):
        return begun
    values = {n: plain.values.get(n, value) for n, value in kept.values.items()}
    return fit_problem(problem, replace(plain, values=values), fit.noise, settle_noise=False, steps=FIRST_STEPS)


def _problem_without(problem: Problem, gone: Sequence[Hypothesis], first: Fit) -> Problem:
    """The problem without the coefficients of some effects, and without effects that then no coefficient moves.

    An effect of the first fit's model stays, and so does one whose deviations between tracks, or whose value for all of
    them, was named too.
    """
    lost = {column for h in gone for column in h.columns}
    deviations = {n: d for n, d in problem.deviations.items() if n not in lost}
    moved, model = {*(problem.free.keys() - lost), *(d.coefficient for d in deviations.values())}, problem.model
    for effect in dict.fromkeys(h.effect for h in gone):
        strengths = {f"{effect.kind}.{effect.name}.{c.name}" for c in effect.coefficients if c.absent is not None}
        if not (strengths & moved or has_effect(first.problem.model, effect.name)):
            model = without_effect(model, effect.name)
    left = dict(model.named_parameters())
    deviations = {n: d for n, d in deviations.items() if d.coefficient in left}
    free = {n: c for n, c in problem.free.items() if (n in left or n in deviations) and n not in lost}
    return replace(problem, model=model, free=free, deviations=deviations)
