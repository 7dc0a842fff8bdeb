"""Holds all models that a search has weighed, with their probabilities, and fits them without some of their effects."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from operator import attrgetter

import numpy as np

from ballfg.arrays import Mask
from ballfg.diagnosis.evidence.halves import unlike_halves
from ballfg.diagnosis.evidence.odds import Odds, odds_of, scores_of
from ballfg.diagnosis.evidence.prior import centres
from ballfg.diagnosis.evidence.rows import NAMELESS, Motion, Patterns, random_motion
from ballfg.diagnosis.evidence.sets import Sets
from ballfg.diagnosis.evidence.weighed import WORTH_A_STEP, Weighed, weighed
from ballfg.diagnosis.fit.effects import has_effect, with_coefficients, without_effect
from ballfg.diagnosis.fit.fit import alike, fit_problem, followed
from ballfg.diagnosis.fit.problem import Fit, Problem
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.search.refits import FIRST_STEPS, refit_set
from ballfg.diagnosis.search.score import Scored
from ballfg.estimation.batch import do_all

SCORE = attrgetter("score")


class WeighedModels:
    """Everything weighed so far, by the names of the effects, and the best of it.

    Args: first: fit of the declared model to all tracks.  jobs: processes that share the work.
    """

    def __init__(self, first: Fit, jobs: int) -> None:
        self.first, self.jobs = first, jobs
        self.halves: Mask = unlike_halves(first)
        self.motion = random_motion(first)  # the same for all models: with another one they cannot be compared
        self.best = weighed(first, (), self.motion, self.halves)
        self.models = {self.best.names: self.best}
        self.tried: set[tuple[frozenset[str], frozenset[str]]] = set()
        self.sets: list[Sets] = []  # beside something nameless, of each search that weighed it

    @cached_property
    def patterns(self) -> Patterns:
        """Patterns without a name about the declared model's fit, the same for all models."""
        return Patterns.of(self.models[frozenset()].fit)

    @property
    def odds(self) -> Odds:
        """Probabilities over all models weighed so far."""
        return odds_of(list(self.models.values()))

    @property
    def scores(self) -> dict[frozenset[str], float]:
        """Logarithm of the odds of all models weighed or foretold so far."""
        return scores_of(list(self.models.values()))

    def most_probable(self, models: Iterable[Weighed]) -> Weighed | None:
        """The best of some models weighed before; None without any."""
        scores = self.scores
        return max(models, key=lambda model: scores[model.names], default=None)

    def is_better(self, model: Weighed | None, than: Weighed | None = None, by: float = 0.0) -> bool:
        """Whether a model weighed before is more probable than another one, None: than the best one so far.

        Args: by: least logarithm of their odds.
        """
        scores = self.scores
        return model is not None and scores[model.names] > scores[(than or self.best).names] + by

    def add(self, sets: Sets) -> None:
        """Sets beside something nameless count from now on, each about the path about which it weighs most."""
        self.sets.append(sets)
        known, best = self.models[sets.screen.model.names], sets.weights
        for names, weight in known.neighbours.items():
            best[names] = max(weight, best.get(names, weight), key=SCORE)
        self.models[known.names] = replace(known, neighbours=best)

    def model(self, names: frozenset[str]) -> Weighed:
        """A model weighed before, or that of a set of effects beside something nameless."""
        if names not in self.models:
            self.models[names] = model_of(self._sets_with(names), names, self.first)
        return self.models[names]

    def _sets_with(self, names: frozenset[str]) -> Sets:
        """The sets among which one is the most probable; several searches may have come to it."""
        return max((sets for sets in self.sets if names in sets.members), key=lambda sets: sets.score(names))

    def rest(self, gone: Sequence[Hypothesis], model: Weighed) -> Weighed:
        """A model without some of its effects, and without those that need them."""
        if model.nameless and any(model.names in sets.members for sets in self.sets):
            return self.model(self._sets_with(model.names).without(model.names, [h.name for h in gone]))
        return self.without(gone, model)

    def named_at(self, probability: float) -> Weighed:
        """The model with all effects that are at least so probable, or with most of them.

        Of several that can hardly be told apart, the most probable one stands for all.
        """
        odds, best = self.odds, self.best.names
        likely = {name for name in odds.effects() if odds.of(name) >= probability} | {NAMELESS}
        if best in odds.models:
            likely |= {h.name for h in self.best.named if odds.together(h.name, best) >= probability}
        if gone := [h for h in self.best.named if h.name not in likely]:
            self.rest(gone, self.best)
            odds = self.odds
        able = [model for model in self.models.values() if model.names <= likely]
        return max(able, key=lambda model: (len(model.named), odds.models[model.names]))

    def known(self, found: Sequence[Weighed]) -> list[Weighed]:
        """Models with their effects in the best minimum of all that were found, each once; they count from now on."""
        for model in found:
            self.models[model.names] = max(self.models.get(model.names, model), model, key=SCORE)
        return [self.models[names] for names in dict.fromkeys(model.names for model in found)]

    def plain(self, model: Weighed) -> Weighed:
        """The same model without something nameless."""
        names = model.names - {NAMELESS}
        if names not in self.models:
            self.models[names] = weighed(model.fit, model.named, self.motion, self.halves, model)
        return self.models[names]

    def without(self, gone: Sequence[Hypothesis], model: Weighed | None = None) -> Weighed:
        """A model without some of its effects, and without those that need them."""
        return self.without_each([gone], model or self.best)[0]

    def without_each(self, each: Iterable[Sequence[Hypothesis]], model: Weighed) -> list[Weighed]:
        """The models without some effects or others, weighed again from there if they were in poorer minima before."""
        asked, tasks = list[frozenset[str]](), dict[frozenset[str], Callable[[], Weighed]]()
        for listed in each:
            lost = {h.effect.name for h in listed if not has_effect(self.first.problem.model, h.effect.name)}
            gone = [h for h in model.named if h in listed or lost & set(h.effect.needs)]
            names = frozenset(h.name for h in model.named if h not in gone)
            asked.append(names)
            before, foretold = self.models.get(names), model.nested.get(names)
            poor = before and foretold and before.score < foretold.score - WORTH_A_STEP
            if before is None or (poor and (model.names, names) not in self.tried):
                self.tried.add((model.names, names))
                tasks[names] = partial(weighed_without, model, gone, self.first, self.motion, self.halves)
        self.known(do_all(list(tasks.values()), self.jobs))
        return [self.models[names] for names in asked]


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
    return without_named(model.alike, gone, first)


def weighed_without(model: Weighed, gone: Sequence[Hypothesis], first: Fit, motion: Motion, halves: Mask) -> Weighed:
    """A model without some of its effects, from where `smaller_fit` leads.  Args: as of `smaller_fit`, `weighed`.

    Where that is a poorer minimum than the linearisation foretells, steps of the fit may lead to a better one.
    """
    kept = [h for h in model.named if h not in gone]
    found = weighed(smaller_fit(model, gone, first), kept, motion, halves, model)
    foretold = model.nested.get(model.names - {h.name for h in gone})
    if foretold is None or found.score > foretold.score - WORTH_A_STEP:
        return found
    other = without_named(model.alike, gone, first)
    if not np.isfinite(other.cost):
        return found
    return max(found, weighed(other, kept, motion, halves, model), key=lambda one: one.score)


def without_named(fit: Fit, gone: Sequence[Hypothesis], first: Fit) -> Fit:
    """A few steps of the fit without some of the effects added to the first one's model, at the same noise.

    They begin at the first one's values where a ball leaves its path without an effect: a large lift that saturates
    without its saturation, say.
    """
    fit = alike(fit)
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

    An effect of the first fit's model stays, and one whose value for all tracks, or deviations between them, is named.
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
