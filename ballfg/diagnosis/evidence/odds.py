"""Probabilities of effects from the evidence of all models that were weighed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from ballfg.diagnosis.evidence.rows import NAMELESS
from ballfg.diagnosis.evidence.weighed import Weighed, Weight

ALIKE = 0.05  # Odds of another effect in an effect's place above which the two cannot be told apart
SURELY = 2.0  # Standard errors by which the gain on the other half must fall short of the evidence to take its place


@dataclass(frozen=True)
class Odds:
    """Probabilities of the models that were weighed."""

    models: Mapping[frozenset[str], float] = field(default_factory=dict)
    """Probability by the names of the effects in it, with `NAMELESS` for patterns without a name."""

    def of(self, name: str) -> float:
        """Probability that an effect is there."""
        return float(sum(p for names, p in self.models.items() if name in names))

    @property
    def nothing(self) -> float:
        """Probability that nothing is there, neither an effect nor something nameless."""
        return self.models.get(frozenset(), 1.0)

    @property
    def nameless(self) -> float:
        """Probability that something nameless is there."""
        return self.of(NAMELESS)

    def alike(self, name: str, model: frozenset[str]) -> list[str]:
        """Effects that can hardly be told from one of a model: in its place they are at least `ALIKE` as probable.

        The most probable one comes first.
        """
        least, rest = self.models[model] * ALIKE, model - {name}
        others = {names: p for names, p in self.models.items() if p > least and rest < names and name not in names}
        listed = sorted(others, key=lambda names: (-others[names], sorted(names)))
        return list(dict.fromkeys(other for names in listed for other in sorted(names - rest - {NAMELESS})))

    def together(self, name: str, model: frozenset[str]) -> float:
        """Probability that an effect of a model is there, or one of those that can hardly be told from it."""
        group = {name, *self.alike(name, model)}
        return float(sum(p for names, p in self.models.items() if names & group))

    def effects(self) -> dict[str, float]:
        """Probability of each effect in any model, the most probable first."""
        names = {name for model in self.models for name in model} - {NAMELESS}
        return dict(sorted(((name, self.of(name)) for name in names), key=lambda item: -item[1]))


def odds_of(models: Sequence[Weighed]) -> Odds:
    """The probabilities of all models, of the smaller ones that they hold, and of their neighbours."""
    scores = scores_of(models, doubtful=True)
    return Odds(dict(zip(scores, special.softmax(list(scores.values())).tolist(), strict=True)))


def scores_of(models: Sequence[Weighed], *, doubtful: bool = False) -> dict[frozenset[str], float]:
    """Logarithm of the odds of all models, of the smaller ones that they hold, and of their neighbours, by their names.

    Each half is predicted with the coefficients of the other. If further effects are there, they gain about as much
    there as in evidence. Where their gain over a smaller model is less by more than chance, it takes the place of that
    evidence.

    Models that no refit weighed count as foretold, and lose what those lose whose linearisations foretell them. Beside
    patterns each weight is of a linearisation, and the best counts.

    Args: doubtful: take off what `_doubt` says. A search hopes for the best and refits it.
    """
    lost = {model.names: -np.inf for model in models if not np.isfinite(model.evidence)}
    models = [model for model in models if np.isfinite(model.evidence)]
    weighed = {model.names: model for model in models}
    scores = {names: tempered(names, weight, weighed) + weight.odds for names, weight in weighed.items()}
    found: dict[frozenset[str], float] = {}
    for model in models:
        for names, score in foretold(model, {**model.nested, **model.neighbours}, scores, weighed).items():
            less = _doubt(model, names, weighed) if doubtful else 0.0
            found[names] = max(score - less, found.get(names, -np.inf))
    beside = {n: max(scores[n], found[n]) for n in scores.keys() & found.keys() if NAMELESS in n}
    return lost | found | scores | beside


def foretold(
    model: Weighed,
    others: Mapping[frozenset[str], Weight],
    scores: Mapping[frozenset[str], float],
    weighed: Mapping[frozenset[str], Weight],
) -> dict[frozenset[str], float]:
    """Logarithm of the odds of others by their names, as the linearisation of a model foretells them.

    Beside patterns sets are compared among themselves: which ones were also weighed without patterns is chance.

    Args: scores, weighed: of the models that were weighed and have an evidence.
    """
    lost, known = scores[model.names] - model.score, others if NAMELESS in model.names else weighed
    return {n: min(lost + w.score, tempered(n, w, known) + w.odds) for n, w in others.items()}


def _doubt(model: Weighed, names: frozenset[str], weighed: Mapping[frozenset[str], Weight]) -> float:
    """What a model with a further effect, or with another one in the place of one, may be foretold to gain too much."""
    if model.names < names:
        return _doubt_beside(model, names, weighed)
    rest = names & model.names
    without, known = model.nested.get(rest), weighed.get(rest)
    if without is None or known is None or not len(rest) + 1 == len(names) == len(model.names):
        return 0.0
    # Far beyond the linear range the linearisation foretells that the tracks hardly need the effect, and so nothing in
    # its place. Where a refit without it says that they do, the other one loses the difference, up to the share of the
    # effect's own gain that it foretells.
    needed, other = model.score - without.score, model.neighbours[names].score - without.score
    share = min(max(other, 0.0) / needed, 1.0) if needed > 0.0 else 0.0
    return (1.0 - share) * max(without.evidence - known.evidence, 0.0)


def _doubt_beside(model: Weighed, names: frozenset[str], weighed: Mapping[frozenset[str], Weight]) -> float:
    """The doubt in a further effect: what its refit beside all but one effect of a model is worse than foretold.

    It loses what the absence of that one alone is off. The one that the model needs least leads least far away.
    """
    refitted = {fewer: names - model.names | fewer for fewer in model.nested if fewer in weighed}
    able = [fewer for fewer, other in refitted.items() if other in weighed and other in model.neighbours]
    if not able:
        return 0.0
    fewer = max(able, key=lambda one: weighed[one].evidence)
    absence = model.nested[fewer].evidence - weighed[fewer].evidence
    off = model.neighbours[refitted[fewer]].evidence - weighed[refitted[fewer]].evidence - absence
    return float(np.clip(off, 0.0, max(model.neighbours[names].evidence - model.evidence, 0.0)))


def tempered(names: frozenset[str], weight: Weight, others: Mapping[frozenset[str], Weight]) -> float:
    """The evidence of a model as far as the other half bears out what it gains over each smaller one.

    A smaller one that is itself doubtful takes nothing from it: an effect may act only beside another. What is gained
    since the coefficients of a smaller one are improbable by their priors, no half can bear out: it counts as it is.

    Args: others: the models that were weighed.
    """
    smaller = [other for known, other in others.items() if known < names and other.evidence < weight.evidence]
    if not smaller:
        return weight.evidence
    evidence = np.array([other.evidence for other in smaller])
    gains = weight.held_out - np.stack([other.held_out for other in smaller])
    of_priors = np.maximum(weight.prior - np.array([other.prior for other in smaller]), 0.0)
    most = of_priors + gains.sum(axis=1) + SURELY * gains.std(axis=1, ddof=1) * np.sqrt(gains.shape[1])
    return float((evidence + np.clip(most, 0.0, weight.evidence - evidence)).min())
