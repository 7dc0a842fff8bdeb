"""Foretells the evidence of sets of candidates from one linearisation, to choose which sets are refitted.

One pass over the tracks gives the inner products of all candidates. Every set of them then costs a small linear
solution, so that effects which only help together are found together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy import special

from ballfg.arrays import Array, Index
from ballfg.diagnosis.evidence.likelihood import Likelihood, Posterior, Reduced, posterior
from ballfg.diagnosis.evidence.prior import WIDTHS, centres, choice_odds, log_odds, scales, within
from ballfg.diagnosis.evidence.rows import Motion, roots, rows_of
from ballfg.diagnosis.evidence.weighed import Priors, Step, Weighed
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.state import STATE_DIM

KEPT: Final = 6
"""Number of the most probable sets of each size that are enlarged."""


@dataclass(frozen=True)
class Screen:
    """Inner products of a model's common unknowns and of the strengths of all candidates, summed over the tracks.

    Attributes:
        model: without the candidates.
        candidates: the hypotheses.
        likelihood: with the columns of their strengths last.
        total: the same, first states and random motion integrated out.
        priors: of the model's own common unknowns.
    """

    model: Weighed
    candidates: Sequence[Hypothesis]
    likelihood: Likelihood
    total: Reduced
    priors: Priors

    @classmethod
    def of(cls, model: Weighed, motion: Motion, candidates: Sequence[Hypothesis], columns: Array) -> Screen:
        """The screen of a model.

        Args: motion: random columns of its fit.  columns: (n, m, p) of all strengths, as in the fit's system.
        """
        rows = rows_of(model.fit, motion)
        wide = replace(rows, by_common=np.concatenate((rows.by_common, columns / roots(model.fit)), axis=-1))
        likelihood = Likelihood(wide, *model.weights)
        reduced, _ = likelihood.reduced(model.noise)
        summed = Reduced(reduced.constant.sum(keepdims=True), reduced.gram.sum(axis=0, keepdims=True))
        return cls(model, candidates, likelihood, summed, Priors.of(model.fit, model.named))

    @cached_property
    def gains(self) -> list[float]:
        """Logarithm of the evidence with each candidate over that of the model, at the model's noise."""
        return [gain for gain, *_ in self._alone]

    def odds(self, chosen: Sequence[int]) -> float:
        """Logarithm of the posterior odds of the model with some candidates to the model itself."""
        listed = [self.candidates[one] for one in chosen]
        widths = [self._alone[one][1] for one in chosen]
        mixed = sum(self._alone[one][2] for one in chosen)
        evidence = self._posterior(chosen, widths).evidence - self._base + mixed
        return evidence + choice_odds(listed) + log_odds(listed)

    def sets(self, offered: Sequence[int], most: int) -> list[tuple[int, ...]]:
        """Sets of up to `most` of the candidates offered, each more probable than all its parts; the best first.

        The most probable sets of each size are enlarged by one candidate after the other.
        """
        found = {(one,): self.odds((one,)) for one in offered}
        best = self._leading(found)
        for _ in range(most - 1):
            larger: dict[tuple[int, ...], float] = {}
            for chosen in best:
                names = self._names(chosen)
                for one in offered:
                    both = tuple(sorted((*chosen, one)))
                    if self.candidates[one].name not in names and both not in larger:
                        larger[both] = self.odds(both)
            gained = {c: o for c, o in larger.items() if o > max(found.get(part, -np.inf) for part in _parts(c))}
            best = self._leading(gained)
            found |= {chosen: gained[chosen] for chosen in best}
        return self._leading(found, len(found))

    @cached_property
    def exchanges(self) -> dict[tuple[str, int], float]:
        """Score of the model with a candidate in place of an effect, by the effect's name and the candidate."""
        found: dict[tuple[str, int], float] = {}
        widths, effects = list(self.model.widths), [h for h in self.model.named if h.strengths]
        for place, effect in enumerate(effects):
            without = self.model.names - {effect.name}
            if without not in self.model.nested:
                continue
            held = self.priors.held([place], widths)
            base = self._posterior([], [], held).evidence
            for one, candidate in enumerate(self.candidates):
                _, width, mixed = self._alone[one]
                gain = self._posterior([one], [width], held).evidence - base + mixed
                gain += choice_odds([candidate]) + log_odds([candidate])
                found[effect.name, one] = self.model.nested[without] + gain
        return found

    def neighbours(self) -> dict[frozenset[str], float]:
        """Score of every model with a further candidate, or with one in place of an effect, by the names of effects."""
        found: dict[frozenset[str], float] = {}
        further = {("", one): self.model.score + self.odds((one,)) for one in range(len(self.candidates))}
        for (gone, one), score in (further | self.exchanges).items():
            names = self.model.names - {gone} | {self.candidates[one].name}
            found[names] = max(score, found.get(names, -np.inf))
        return found

    def step(self, chosen: Sequence[int]) -> tuple[Step, Array]:
        """The step to the most probable unknowns beside some candidates, and (s,) their strengths in order."""
        mean = self._posterior(chosen, [self._alone[one][1] for one in chosen]).mean
        common = np.zeros(self.likelihood.rows.by_common.shape[-1])
        common[self._columns(chosen)] = mean
        starts = self.likelihood.local_step(self.model.noise, common)[:, :STATE_DIM]
        return Step(starts, mean[: self._own], 0.0), mean[self._own :]

    def _names(self, chosen: Sequence[int]) -> frozenset[str]:
        return frozenset(self.candidates[one].name for one in chosen)

    def _leading(self, odds: Mapping[tuple[int, ...], float], most: int = KEPT) -> list[tuple[int, ...]]:
        """The most probable sets, each with its candidates in their best shapes."""
        best: dict[frozenset[str], tuple[int, ...]] = {}
        for chosen in sorted(odds, key=lambda chosen: -odds[chosen]):
            best.setdefault(self._names(chosen), chosen)
        return list(best.values())[:most]

    @property
    def _own(self) -> int:
        return len(self.priors.base)

    @cached_property
    def _alone(self) -> list[tuple[float, int, float]]:
        """For each candidate its gain, its most probable width, and the mean evidence of all widths over that."""
        found = []
        for one, candidate in enumerate(self.candidates):
            evidence = np.array([self._posterior([one], [width]).evidence for width in range(len(WIDTHS))])
            best = int(evidence.argmax())
            mixed = float(special.logsumexp(evidence - evidence[best]) - np.log(len(WIDTHS)))
            after = self._posterior([one], [best])
            mean, sigmas = after.mean[self._own :], np.sqrt(np.diagonal(after.covariance)[self._own :])
            centre = centres(candidate, self.model.fit.problem.model)
            mixed += within(candidate, centre, centre + mean, sigmas, WIDTHS[best])
            found.append((float(evidence[best]) + mixed - self._base + choice_odds([candidate]), best, mixed))
        return found

    @cached_property
    def _base(self) -> float:
        return self._posterior([], []).evidence

    @cached_property
    def _ends(self) -> Index:
        return self._own + np.cumsum([0, *(len(candidate.strengths) for candidate in self.candidates)])

    def _columns(self, chosen: Sequence[int]) -> Index:
        """Numbers of the model's own columns and of those of some candidates."""
        strengths = [np.arange(self._ends[one], self._ends[one + 1]) for one in chosen]
        return np.concatenate((np.arange(self._own), *strengths))

    def _posterior(self, chosen: Sequence[int], widths: Sequence[int], precision: Array | None = None) -> Posterior:
        """With some candidates in some widths; precision: of the model's own unknowns, if not as in the model."""
        columns = self._columns(chosen)
        listed = np.append(columns, self.total.gram.shape[-1] - 1)
        part = Reduced(self.total.constant, self.total.gram[:, listed[:, None], listed])
        sizes = [WIDTHS[width] * scales(self.candidates[one]) for one, width in zip(chosen, widths, strict=True)]
        own = self.priors.precision(self.model.widths) if precision is None else precision
        whole = np.concatenate((own, *(size**-2 for size in sizes)))
        return posterior(part, whole, np.append(self.priors.away, np.zeros(len(columns) - self._own)))


def _parts(chosen: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The sets with one candidate less."""
    return [chosen[:place] + chosen[place + 1 :] for place in range(len(chosen))]
