"""All models that a search has weighed, with their probabilities, and the models without some of their effects."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from operator import attrgetter

from ballfg.arrays import Mask
from ballfg.diagnosis.evidence.halves import unlike_halves
from ballfg.diagnosis.evidence.odds import Odds, odds_of, scores_of
from ballfg.diagnosis.evidence.rows import NAMELESS, Patterns, random_motion
from ballfg.diagnosis.evidence.sets import Sets
from ballfg.diagnosis.evidence.weighed import WORTH_A_STEP, Weighed, weighed
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis, has_effect
from ballfg.diagnosis.search.changed_fits import model_of, weighed_without
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
        """A model without some of its effects, and without those that need them.

        It is weighed again from there if the linearisation says that it was found in a poorer minimum before.
        """
        return self.without_each([gone], model or self.best)[0]

    def without_each(self, each: Iterable[Sequence[Hypothesis]], model: Weighed) -> list[Weighed]:
        """The models without some effects or others, side by side."""
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
