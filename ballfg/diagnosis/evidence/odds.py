"""Probabilities of effects from the evidence of all models that were weighed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from ballfg.diagnosis.evidence.nameless import NAMELESS
from ballfg.diagnosis.evidence.weighed import Weighed

ALIKE = 0.05
"""Odds of another effect in an effect's place above which the two cannot be told apart."""
SURELY = 2.0
"""Standard errors by which the gain on the other half must fall short of the evidence to be believed instead."""


@dataclass(frozen=True)
class Odds:
    """Probabilities of the models that were weighed.

    Attributes:
        models: probability by the names of the effects in it, with `NAMELESS` for patterns without a name.
    """

    models: Mapping[frozenset[str], float] = field(default_factory=dict)

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
        """Effects that can hardly be told from one of a model: in its place they are at least `ALIKE` as probable."""
        least, rest = self.models[model] * ALIKE, model - {name}
        others = [names for names, p in self.models.items() if p > least and rest < names and name not in names]
        return sorted({other for names in others for other in names - rest} - {NAMELESS})

    def together(self, name: str, model: frozenset[str]) -> float:
        """Probability that an effect of a model is there, or one of those that can hardly be told from it."""
        group = {name, *self.alike(name, model)}
        return float(sum(p for names, p in self.models.items() if names & group))

    def effects(self) -> dict[str, float]:
        """Probability of each effect in any model, the most probable first."""
        names = {name for model in self.models for name in model} - {NAMELESS}
        return dict(sorted(((name, self.of(name)) for name in names), key=lambda item: -item[1]))


def tempered(model: Weighed, declared: Weighed) -> float:
    """The evidence of a model over that of the declared one, as far as the other half bears it out.

    Each half is predicted with the coefficients of the other. If the model is right, its gain there is about the
    evidence. Where it is smaller by more than chance, the likelihood is raised to a power that makes them equal.
    """
    promised = model.evidence - declared.evidence
    gains = model.held_out - declared.held_out
    most = float(gains.sum() + SURELY * gains.std(ddof=1) * np.sqrt(len(gains)))
    return float(np.clip(most, 0.0, promised)) if promised > 0.0 else promised


def odds_of(models: Sequence[Weighed], declared: Weighed) -> Odds:
    """The probabilities of all models, of the smaller ones that they hold, and of their neighbours.

    A refit without an effect may end in a poorer minimum than the model with it. Where strengths are known to be about
    absent, the linearisation with them holds the model without (J. M. Dickey, 1971), and the better of both counts.
    Neighbours that no refit weighed count as foretold.
    """
    scores: dict[frozenset[str], float] = {}
    foretold: dict[frozenset[str], float] = {}
    for model in models:
        score = tempered(model, declared) + model.odds
        smaller = {names: score + other - model.score for names, other in model.nested.items()}
        for names, value in (smaller | {model.names: score}).items():
            scores[names] = max(value, scores.get(names, -np.inf))
        for names, value in model.neighbours.items():
            foretold[names] = max(score + value - model.score, foretold.get(names, -np.inf))
    scores = foretold | scores
    return Odds(dict(zip(scores, special.softmax(list(scores.values())).tolist(), strict=True)))
