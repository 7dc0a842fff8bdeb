"""The steps of a search: from the best model so far to more probable ones, by refits with other effects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Mask
from ballfg.diagnosis.evidence.odds import ALIKE, foretold
from ballfg.diagnosis.evidence.rows import NAMELESS, Motion
from ballfg.diagnosis.evidence.screen import Screen
from ballfg.diagnosis.evidence.sets import Sets
from ballfg.diagnosis.evidence.weighed import Weighed, weighed
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.hypotheses.varying import Grouping, groupings
from ballfg.diagnosis.search.evaluation import on_all
from ballfg.diagnosis.search.models import WeighedModels, smaller_fit, weighed_without
from ballfg.diagnosis.search.refits import Attempt, Refit, refit, retested
from ballfg.diagnosis.search.score import Scored
from ballfg.diagnosis.search.trial import offered_varying, screen_of, try_hypotheses, try_varying
from ballfg.dynamics.variation import place_of
from ballfg.estimation.batch import do_all

if TYPE_CHECKING:
    from ballfg.diagnosis.search.loop import SearchLoop

MOST_EFFECTS = 5  # Largest number of added effects
MOST_ROUNDS = 8  # Largest number of rounds: one adds several effects, or exchanges one
AT_ONCE = 2
"""Number of attempts that are made side by side, whatever the number of processes: results do not depend on it."""
MOST_EXCHANGES = 3  # Largest number of exchanges that a round refits


@dataclass(frozen=True)
class Round:
    """Tests and refits of one round, and the names that it added."""

    scored: Sequence[Scored]
    refits: Sequence[Refit]
    added: tuple[str, ...] = ()


class Found(WeighedModels):
    """The models of a search, and the rounds that led to them."""

    def __init__(self, loop: "SearchLoop", first: Fit) -> None:
        super().__init__(on_all(first, loop.holdout.held_out), loop.jobs)
        self.loop = loop
        self.rounds: list[Round] = []
        self.begun, self.together = 0, MOST_EFFECTS  # round with which a search began; effects that one may add

    def search(self) -> None:
        """Adds, removes and exchanges effects as long as that makes the model more probable, then weighs the rest."""
        self.begun = len(self.rounds)
        while self.step():
            pass
        self.compare()

    def search_again(self) -> None:
        """Searches from the declared model on by single effects; the better one of both searches counts."""
        self.loop.watch("something nameless remains: searching again, one effect at a time")
        before, self.together = self.best, 1
        self.best = self.models[frozenset()]
        self.search()
        self.best = max(self.best, before, key=lambda model: self.scores[model.names])

    def step(self) -> bool:
        """One round, or where none adds anything, removes effects without which a refit is better; False: neither."""
        return (len(self.rounds) < self.begun + MOST_ROUNDS and self.round()) or self._pruned(every=True)

    def round(self) -> bool:
        """Adds the effects that make the model most probable, and removes those that they make superfluous.

        Where none does, or as many as may be are there, one is exchanged for another.
        """
        loop, best, number = self.loop, self.best, len(self.rounds) + 1

        def tell(line: str) -> None:
            loop.watch(f"round {number}: {line}")

        most = min(MOST_EFFECTS - len(best.named), self.together)
        scored, attempts, screen = try_hypotheses(best, self.motion, loop.catalogue, tell, most)
        refits, winner = self._attempted(attempts if most else [], tell)
        scored = retested(scored, refits)
        if not self.is_better(winner):
            if self._refitted(best, screen):
                tell("refits lead to a better fit of the effects that it began with")
                self.rounds.append(Round(scored, refits))
                return True
            if (exchanged := self._exchanged(screen, scored, tell)) is not None:
                self.rounds.append(Round(scored, [*refits, exchanged], (exchanged.name,)))
                return True
        if most and not self.is_better(winner):
            more, attempts = try_varying(best, self.motion, loop.of_some or loop.catalogue, self.ways, tell)
            fitted, other = self._attempted(attempts, tell)
            scored, refits = [*scored, *more], [*refits, *fitted]
            winner = self.most_probable(w for w in (winner, other) if w is not None)
        added = self.is_better(winner)
        names = tuple(h.name for h in winner.named if h not in best.named) if winner is not None and added else ()
        self.rounds.append(Round(scored, refits, names))
        if winner is None or not added:
            tell("nothing makes the model more probable")
            return self._refitted(best, screen)
        gone = [h.name for h in best.named if h not in winner.named]
        tell(" and ".join((*(f"{name} added" for name in names), *(f"{name} removed" for name in gone))))
        self.best = winner
        if best.names < winner.names:  # effects may have led out of a poor minimum of the model without them
            again = self.without([h for h in winner.named if h.name in names], winner)
            self.best = again if self.is_better(again, winner) else winner
        self._pruned()
        return True

    def _refitted(self, before: Weighed, screen: Screen) -> bool:
        """Takes over the best fit of the best model's effects: refits without what they added may lead to a better one.

        Returns: whether it is so much more probable that what else may be there is to be asked anew.
        """
        known = self.models[before.names]
        self.best = self.models[before.names] = replace(known, neighbours=screen.neighbours)
        return known.score > before.score - np.log(ALIKE)

    def _exchanged(self, screen: Screen, scored: Sequence[Scored], tell: Callable[[str], None]) -> Refit | None:
        """The refit with another effect in the place of one that makes the model more probable; None if none does.

        Those that are foretold to come close are refitted. An absence that is many standard deviations away lies beyond
        the linear range, so that close is a share of what the effect explains.
        """
        best, scores = self.best, self.scores
        tasks: dict[frozenset[str], list[Callable[[], tuple[Refit, Weighed | None]]]] = {}

        def exchanged(gone: str, one: int) -> frozenset[str]:
            return best.names - {gone} | {screen.candidates[one].name}

        for gone, one in sorted(screen.exchanges, key=lambda exchange: -scores[exchanged(*exchange)]):
            other, own = screen.candidates[one], next(h for h in best.named if h.name == gone)
            explains = best.score - best.nested[best.names - {gone}].score
            names = exchanged(gone, one)
            close = scores[names] > scores[best.names] - max(-np.log(ALIKE), ALIKE * explains)
            if len(tasks) == MOST_EXCHANGES or not close or names in self.models or names in tasks:
                continue
            tell(f"fitting with {other.name} in place of {gone}")
            candidate = next(s for s in scored if s.hypothesis is other)
            asked = best, own, candidate, self.first, self.motion, self.halves
            tasks[names] = [partial(way, *asked) for way in (_in_place, _first_beside)]
        made = do_all([task for ways in tasks.values() for task in ways], self.jobs)
        winner = self.most_probable(self.known([found for _, found in made if found is not None]))
        if winner is None or not self.is_better(winner):
            return None
        self.best = winner
        refitted = next(refitted for refitted, found in made if found is winner)
        tell(f"{refitted.name} exchanged for another")
        return refitted

    def compare(self) -> None:
        """Weighs something nameless beside the best model, and if it is there, which effects are there beside it.

        Patterns make some effects superfluous. They also show others, which a model that lacks them hides: an effect
        alone takes the values that make up for what no effect describes.
        """
        loop, best = self.loop, self.best
        if not best.neighbours:  # no round looked beyond it: it was the last
            loop.watch("weighing what could stand in place of its effects")
            neighbours = screen_of(best, self.motion, loop.catalogue).neighbours
            self.best = self.models[best.names] = replace(best, neighbours=neighbours)
        loop.watch("weighing what has no name")
        nothing = self.models[frozenset()]  # a name has to beat that at its best
        about = {m.names: m for m in (nothing, self.best)}.values()
        tasks = [partial(weighed, m.fit, m.named, self.motion, self.halves, m, self.patterns) for m in about]
        beside = do_all(tasks, self.jobs)
        self.known(beside)
        scores = self.scores
        if NAMELESS not in max(scores, key=lambda names: scores[names]):
            return
        loop.watch("weighing sets of effects beside it")
        for model in beside:
            varying = offered_varying(model, loop.of_some or loop.catalogue, self.ways)
            screen = screen_of(model, self.motion, loop.catalogue, varying, self.patterns)
            self.add(Sets.near(screen, MOST_EFFECTS))
        scores = self.scores
        able = [*self.models, *(n for sets in self.sets for n in sets.members)]
        known = [n for n in able if n in scores]  # sets about the path of a model in a poorer minimum are not
        self.best = self.model(max(known, key=lambda names: scores[names]))

    @cached_property
    def ways(self) -> list[Grouping]:
        """Ways in which tracks may differ."""
        listed = sorted(dict.fromkeys(self.first.problem.stretches.names), key=place_of)
        return (self.loop.ways or partial(groupings, self.loop.holdout.tracks))(listed)

    def _attempted(
        self, attempts: Sequence[Attempt], tell: Callable[[str], None]
    ) -> tuple[list[Refit], Weighed | None]:
        """The refits of attempts that promise more than is gained, and the most probable model; None without any."""
        refits, winner = list[Refit](), None
        waiting = sorted(attempts, key=lambda attempt: -attempt.gain)
        while waiting and not self.is_better(winner, by=max(waiting[0].gain, 0.0)):
            now, waiting = waiting[:AT_ONCE], waiting[AT_ONCE:]
            for attempt in now:
                tell(f"fitting with {attempt.words}")
            alike = (self.best, self.motion, self.halves)
            tasks = [partial(_weighed_refit, task, *alike) for attempt in now for task in attempt.refits]
            made = do_all(tasks, self.jobs)
            refits += [refitted for refitted, _ in made]
            likely = self._likely([model for _, model in made if model is not None])
            winner = self.most_probable(w for w in (winner, likely) if w is not None)
        return sorted(refits, key=lambda r: r.delta_bic), winner

    def _likely(self, refits: Sequence[Weighed]) -> Weighed | None:
        """The most probable of some refits, and of them without an effect that they make superfluous."""
        best, found = self.best, self.known(refits)
        scores = self.scores
        for model in list(found):
            smaller = self._smaller(model)
            names = max(smaller, key=lambda names: smaller[names], default=model.names)
            if smaller.get(names, -np.inf) > max(scores[model.names], scores[best.names]):
                found.append(self.without([h for h in model.named if h.name not in names], model))
        return self.most_probable(self.models[model.names] for model in found)  # a smaller one may replace its refit

    def _smaller(self, model: Weighed) -> dict[frozenset[str], float]:
        """Logarithm of the odds of the models that a model holds, by their names.

        Those that were not weighed from there count at least as foretold: a refit from elsewhere may be in a poorer
        minimum.
        """
        if not np.isfinite(model.evidence):
            return {}
        others = {names: known for names, known in self.models.items() if np.isfinite(known.evidence)}
        scores = self.scores
        found = foretold(model, model.nested, scores, others)
        return {n: scores[n] if (model.names, n) in self.tried else max(scores[n], score) for n, score in found.items()}

    def _pruned(self, every: bool = False) -> bool:
        """Removes effects that later ones made superfluous, as the linearisation says and a refit confirms.

        Args: every: refit without each effect: a strong one's absence lies beyond the linear range.
        Returns: whether the best model lost an effect.
        """
        whole = self.best
        while True:
            best, gone = self.best, self.best.named
            if not every:
                score, smaller = self.scores[best.names], self._smaller(best)
                gone = tuple(h for h in best.named if smaller.get(best.names - {h.name}, -np.inf) > score)
            least = self.most_probable(self.without_each(([h] for h in gone), best))
            if least is None or not self.is_better(least):
                return self.best is not whole
            self.best = least


def _weighed_refit(
    task: Callable[[], Refit], best: Weighed, motion: Motion, halves: Mask
) -> tuple[Refit, Weighed | None]:
    """A refit of a model with further effects, and how probable it is; None if it has no path."""
    refitted = task()
    if not np.isfinite(refitted.fit.cost):
        return refitted, None
    return refitted, weighed(refitted.fit, (*best.named, *refitted.added), motion, halves, best)


def _in_place(
    best: Weighed, gone: Hypothesis, candidate: Scored, first: Fit, motion: Motion, halves: Mask
) -> tuple[Refit, Weighed]:
    """The refit without an effect and with a candidate in its place, and how probable it is."""
    refitted = refit(smaller_fit(best, [gone], first), candidate)
    named = (*(h for h in best.named if h.name != gone.name), candidate.hypothesis)
    return refitted, weighed(refitted.fit, named, motion, halves, best)


def _first_beside(
    best: Weighed, gone: Hypothesis, candidate: Scored, first: Fit, motion: Motion, halves: Mask
) -> tuple[Refit, Weighed | None]:
    """The same by way of the refit with both; either way may lead into a poor minimum."""
    refitted, both = _weighed_refit(partial(refit, best.fit, candidate), best, motion, halves)
    return refitted, None if both is None else weighed_without(both, [gone], first, motion, halves)
