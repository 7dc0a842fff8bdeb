"""Weighs sets of effects beside something nameless, all from one linearisation.

Patterns follow the samples wherever the effects alone do not, so that two refits would hold the errors of two
linearisations. About the path that comes closest to the samples, the linear model of all sets is the same.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from ballfg.diagnosis.evidence.odds import tempered
from ballfg.diagnosis.evidence.screen import Beside, Gone, Screen
from ballfg.diagnosis.evidence.weighed import Weight
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis


@dataclass(frozen=True)
class Member:
    """A set: the model without some of its effects, with some candidates, and its weight."""

    weight: Weight
    beside: Beside
    gone: Gone


@dataclass(frozen=True)
class Sets:
    """Sets of up to `most` of a model's effects and of candidates, by their names, as far as they were weighed."""

    screen: Screen
    most: int
    members: dict[frozenset[str], Member] = field(default_factory=dict)

    @classmethod
    def near(cls, screen: Screen, most: int) -> "Sets":
        """The most probable set that single effects lead to, from all of the model's and from none, and its kin."""
        found = cls(screen, most)
        model = screen.model
        found.members[model.names] = Member(model, (), ())
        for names, weight in model.nested.items():
            gone = tuple(place for place, h in enumerate(screen.effects) if h.name not in names)
            found.members[names] = Member(weight, (), gone)
        for names in (model.names, min(found.members, key=len)):
            found._climb(names)
        return found

    @property
    def weights(self) -> dict[frozenset[str], Weight]:
        """The weight of each set."""
        return {names: member.weight for names, member in self.members.items()}

    def score(self, names: frozenset[str]) -> float:
        """Logarithm of the odds of a set, as far as the other half bears out what it gains over smaller ones."""
        weight = self.members[names].weight
        return tempered(names, weight, self.weights) + weight.odds

    def listed(self, names: frozenset[str]) -> tuple[list[Hypothesis], list[Hypothesis]]:
        """The model's effects that a set lacks, and the candidates in it."""
        member, screen = self.members[names], self.screen
        return [screen.effects[place] for place in member.gone], [screen.candidates[one] for one, _ in member.beside]

    def without(self, names: frozenset[str], gone: Iterable[str]) -> frozenset[str]:
        """A set without some of its effects and those that need them, which is weighed if it was not yet."""
        lost = set(gone) & names
        listed = {h.name: h for h in (*self.screen.effects, *self.screen.candidates) if h.name in names}
        kinds = {listed[name].effect.name for name in lost}
        lost |= {name for name, h in listed.items() if kinds & set(h.effect.needs)}
        return self._rest(names, lost)

    def _climb(self, names: frozenset[str]) -> None:
        """Adds and removes single effects as long as that makes a set more probable; if none does, exchanges one."""
        best = names
        while True:
            smaller = [names for names in self._smaller(best) if names in self.members]
            better = self._best(best, [*self._larger(best), *smaller])
            if better == best:
                better = self._best(best, [n for rest in smaller for n in self._larger(rest)])
            if better == best:
                return
            best = better

    def _best(self, best: frozenset[str], others: Iterable[frozenset[str]]) -> frozenset[str]:
        """The most probable of a set and others; what the other half bears out is at most the evidence."""
        most = self.score(best)
        for names in sorted(set(others), key=lambda names: -self.members[names].weight.score):
            if self.members[names].weight.score <= most:
                break
            if (score := self.score(names)) > most:
                best, most = names, score
        return best

    def _smaller(self, names: frozenset[str]) -> list[frozenset[str]]:
        """The sets with one effect less; those that no larger one led to are weighed."""
        member, screen = self.members[names], self.screen
        kept = [h for place, h in enumerate(screen.effects) if place not in member.gone]
        return [self._rest(names, {h.name}) for h in (*(screen.candidates[one] for one, _ in member.beside), *kept)]

    def _larger(self, names: frozenset[str]) -> list[frozenset[str]]:
        """The sets with one candidate more, each in its best shape."""
        member, screen, found = self.members[names], self.screen, set[frozenset[str]]()
        if len(names) > self.most:  # one of the names is that of the patterns
            return []
        for one, candidate in enumerate(screen.candidates):
            if candidate.name not in names and self._stands(member.gone, [*(c for c, _ in member.beside), one]):
                weight, beside = screen.with_one(one, member.weight, member.beside, member.gone)
                larger = names | {candidate.name}
                if larger not in self.members or weight.score > self.members[larger].weight.score:
                    self.members[larger] = Member(weight, beside, member.gone)
                found.add(larger)
        return list(found)

    def _rest(self, names: frozenset[str], lost: set[str]) -> frozenset[str]:
        """A set without some effects, which is weighed if it was not yet, and if none of the others needs them."""
        member, screen, rest = self.members[names], self.screen, names - lost
        places = {place for place, h in enumerate(screen.effects) if h.name in lost}
        gone = tuple(sorted({*member.gone, *places}))
        chosen = [one for one, _ in member.beside if screen.candidates[one].name not in lost]
        if rest not in self.members and self._stands(gone, chosen):
            plain = screen.model.names - {screen.effects[place].name for place in gone}
            weight, beside = self.members[plain].weight, Beside()
            for one in chosen:
                weight, beside = screen.with_one(one, weight, beside, gone)
            self.members[rest] = Member(weight, beside, gone)
        return rest

    def _stands(self, gone: Gone, chosen: Iterable[int]) -> bool:
        """True if no effect of a set needs one that is gone."""
        screen = self.screen
        lost = {screen.effects[place].effect.name for place in gone}
        kept = [h for place, h in enumerate(screen.effects) if place not in gone]
        return not any(lost & set(h.effect.needs) for h in (*kept, *(screen.candidates[one] for one in chosen)))
