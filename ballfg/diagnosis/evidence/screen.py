"""Foretells the evidence of sets of candidates from one linearisation, to choose which sets are refitted.

One pass over the tracks gives the inner products of all candidates. Every set of them then costs a small linear
solution, so that effects which only help together are found together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from scipy import special

from ballfg.arrays import Array, Index
from ballfg.diagnosis.evidence.condensed import Condensed
from ballfg.diagnosis.evidence.likelihood import Batches, Posterior, Reduced, posterior
from ballfg.diagnosis.evidence.odds import tempered
from ballfg.diagnosis.evidence.prior import WIDTHS, Priors, centres, choice_odds, log_odds, scales, within
from ballfg.diagnosis.evidence.rows import Motion, Patterns, roots, rows_beside
from ballfg.diagnosis.evidence.weighed import Strengths, Weighed, Weight
from ballfg.diagnosis.fit.stretches import batches_of
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis

TRIED: Final = tuple(range(0, len(WIDTHS), 2))  # Numbers of the widths that are tried: a screen needs no finer ones
KEPT: Final = 6  # Number of the most probable sets of each size that are enlarged


Beside = tuple[tuple[int, int], ...]  # Numbers of candidates, each with that of its width
_Odds = Mapping[tuple[int, ...], float]  # Logarithms, by the numbers of the candidates of a set
Gone = tuple[int, ...]  # Places of the model's own effects with strengths that are left out


@dataclass(frozen=True)
class Screen:
    """Inner products of a model's common unknowns and of the strengths of all candidates.

    They are taken at the model's noise, and at the same noise with coefficients that do not scatter from track to
    track: what all tracks have alike counts as scatter as long as no effect explains it. The better one counts.
    """

    model: Weighed  # Without the candidates
    candidates: Sequence[Hypothesis]
    tracks: tuple[Reduced, ...]
    """At each noise, of each track, with the columns of strengths last; states and random motion integrated out."""
    priors: Priors  # Of the model's own common unknowns
    _known: "dict[tuple[Beside, int, Gone], _Gain]" = field(default_factory=dict)
    _best: dict[tuple[Beside, Gone], tuple[int, float]] = field(default_factory=dict)
    _condensed: dict[tuple[Gone, int], Condensed] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        model: Weighed,
        motion: Motion,
        candidates: Sequence[Hypothesis],
        columns: Array,
        patterns: Patterns | None = None,
    ) -> "Screen":
        """The screen of a model.

        Args: motion: random columns of its fit.  columns: (n, m, p) of all strengths, as in the fit's system.
            patterns: without a name, that the model was weighed with.
        """
        stretches, strengths = model.fit.problem.stretches, columns / roots(model.fit)
        batches = zip(rows_beside(model.fit, motion, patterns), batches_of(stretches.used.numpy()), strict=True)
        wide = [rows.beside(batch.of(strengths)) for rows, batch in batches]
        likelihood = Batches.of(wide, model.weights)
        noises = [model.noise, model.noise.calm] if model.noise.scatters else [model.noise]
        tracks = tuple(likelihood.reduced(noise)[0].by_track(stretches.track) for noise in noises)
        return cls(model, candidates, tracks, Priors.of(model.fit, model.named, patterns))

    @cached_property
    def gains(self) -> list[float]:
        """What each candidate adds to the evidence, at the model's noise, as far as the other half bears it out."""
        alone = {self.model.names: self.model}
        found = (tempered(self._names((one,)), weight, alone) for one, weight in enumerate(self._singles))
        return [evidence - self.model.evidence for evidence in found]

    @cached_property
    def _singles(self) -> list[Weight]:
        """The weight of the model with each candidate."""
        return [self.with_one(one, self.model)[0] for one in range(len(self.candidates))]

    def odds(self, chosen: Sequence[int]) -> float:
        """Logarithm of the posterior odds of the model with some candidates, added in turn, to the model itself."""
        gain, _ = self._together(chosen)
        listed = [self.candidates[one] for one in chosen]
        return gain + choice_odds(listed) + log_odds(listed)

    def _together(self, chosen: Sequence[int]) -> tuple[float, Beside]:
        """What candidates that are added in turn gain, and with which widths."""
        gain, beside = 0.0, Beside()
        for one in chosen:
            more = self._beside(beside, one)
            gain, beside = gain + more.gain, (*beside, (one, more.width))
        return gain, beside

    def sets(self, offered: Sequence[int], most: int) -> dict[tuple[int, ...], float]:
        """Sets of up to `most` of the candidates offered, each more probable than all its parts; the best first.

        The values are the logarithms of their posterior odds to the model itself, as far as the other half bears them
        out. The most probable sets of each size are enlarged by one candidate after the other.
        """
        found: dict[tuple[int, ...], float] = {(one,): self.odds((one,)) for one in offered}
        best, others = self._leading(found), dict[frozenset[str], Weight]({self.model.names: self.model})
        scores = self._borne_out(best, others)
        for _ in range(most - 1):
            larger: dict[tuple[int, ...], float] = {}
            for chosen in best:
                names, known = self._names(chosen), {frozenset(c) for c in larger}
                for one in offered:
                    if self.candidates[one].name not in names and frozenset((*chosen, one)) not in known:
                        larger[*chosen, one] = self.odds((*chosen, one))
            best = self._leading(_beyond_parts(larger, found))
            found |= {chosen: larger[chosen] for chosen in best}
            more = _beyond_parts(self._borne_out(best, others), scores)
            best, scores = list(more), scores | more
        return dict(sorted(scores.items(), key=lambda item: -item[1]))

    def _borne_out(
        self, leading: Sequence[tuple[int, ...]], others: dict[frozenset[str], Weight]
    ) -> dict[tuple[int, ...], float]:
        """Odds of sets to the model, as far as the other half bears them out; adds them to the others."""
        found = {}
        for chosen in leading:
            gain, beside = self._together(chosen)
            listed, names = [self.candidates[one] for one in chosen], self._names(chosen)
            density = self._held_out(beside)
            evidence, prior = self.model.evidence + gain + choice_odds(listed), self._posterior(beside).prior
            weight = Weight(evidence, log_odds(listed), density, prior)
            found[chosen] = tempered(names, weight, others) - self.model.evidence + weight.odds
            others[names] = weight
        return found

    @cached_property
    def exchanges(self) -> dict[tuple[str, int], Weight]:
        """The weight of the model with a candidate in place of an effect, by the effect's name and the candidate."""
        found: dict[tuple[str, int], Weight] = {}
        for place, effect in enumerate(self.effects):
            rest = self.model.nested.get(self.model.names - {effect.name})
            if rest is not None:
                for one in range(len(self.candidates)):
                    found[effect.name, one], _ = self.with_one(one, rest, gone=(place,))
        return found

    @cached_property
    def neighbours(self) -> dict[frozenset[str], Weight]:
        """The weight of every model with a further candidate, or with one in place of an effect, by its names."""
        found: dict[frozenset[str], Weight] = {}
        further = {("", one): weight for one, weight in enumerate(self._singles)}
        for (gone, one), weight in (further | self.exchanges).items():
            names = self.model.names - {gone} | {self.candidates[one].name}
            if names not in found or weight.score > found[names].score:
                found[names] = weight
        return found

    @property
    def effects(self) -> list[Hypothesis]:
        """The model's own effects with strengths."""
        return [h for h in self.model.named if h.strengths]

    def with_one(self, one: int, rest: Weight, beside: Beside = (), gone: Gone = ()) -> tuple[Weight, Beside]:
        """The weight of the rest with one more candidate, and the candidates with their widths.

        Args: rest: the weight of the model beside some candidates, without what is gone.
        """
        more, listed = self._beside(beside, one, gone), [self.candidates[one]]
        beside = (*beside, (one, more.width))
        evidence = rest.evidence + more.gain + choice_odds(listed)
        prior = self._posterior(beside, gone).prior
        return Weight(evidence, rest.odds + log_odds(listed), self._held_out(beside, gone), prior), beside

    def strengths(self, beside: Beside, gone: Gone = ()) -> dict[str, Strengths]:
        """The strengths of all effects and candidates, by name."""
        found, fit = self._posterior(beside, gone), self.model.fit
        values = np.array([fit.unknowns.values[name] for name in fit.problem.free])
        places = {h.name: place for h, place in zip(self.effects, self.priors.places, strict=False)}
        starts = {name: values[place] for name, place in places.items()}
        end = self._own
        for one, _ in beside:
            name, size = self.candidates[one].name, len(self.candidates[one].strengths)
            places[name], starts[name] = np.arange(end, end + size), self._centres[one]
            end += size
        for place in gone:
            del places[self.effects[place].name]
        return {
            name: Strengths(starts[name] + found.mean[place], found.covariance[np.ix_(place, place)])
            for name, place in places.items()
        }

    def step(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """(c,) the step to the most probable unknowns beside some candidates, and (s,) their strengths in order."""
        mean, fit = self._posterior(self._together(chosen)[1]).mean, self.model.fit
        own = len(fit.problem.common_precision)  # those of patterns come after them
        return mean[:own], mean[self._own :]

    def _names(self, chosen: Sequence[int]) -> frozenset[str]:
        return self.model.names | {self.candidates[one].name for one in chosen}

    def _leading(self, odds: _Odds) -> list[tuple[int, ...]]:
        """The most probable sets, each with its candidates in their best shapes."""
        best: dict[frozenset[str], tuple[int, ...]] = {}
        for chosen in sorted(odds, key=lambda chosen: -odds[chosen]):
            best.setdefault(self._names(chosen), chosen)
        return list(best.values())[:KEPT]

    @property
    def _own(self) -> int:
        return len(self.priors.base)

    def _beside(self, beside: Beside, one: int, gone: Gone = ()) -> "_Gain":
        """What one more candidate gains beside others of given widths, without some of the model's effects."""
        key = (beside, one, gone)
        if key in self._known:
            return self._known[key]
        candidate, (_, least) = self.candidates[one], self._noise(beside, gone)
        each = [
            [self._without(gone, noise).whole(*self._further((*beside, (one, width)))) for width in TRIED]
            for noise in range(len(self.tracks))
        ]
        evidences = np.array([[after.evidence for after in found] for found in each])
        noise = int(evidences.max(axis=1).argmax())
        found, evidence = each[noise], evidences[noise]
        best, size = int(evidence.argmax()), len(candidate.strengths)
        mean, sigmas = found[best].mean[-size:], np.sqrt(np.diagonal(found[best].covariance)[-size:])
        centre = self._centres[one]
        inside = within(candidate, centre, centre + mean, sigmas, WIDTHS[TRIED[best]])
        gain = float(special.logsumexp(evidence)) - np.log(len(TRIED)) - least + inside
        self._known[key] = _Gain(float(gain), TRIED[best])
        return self._known[key]

    def _held_out(self, beside: Beside, gone: Gone = ()) -> Array:
        """(t,) as of `Weight`."""
        return self._without(gone, self._noise(beside, gone)[0]).held_out(*self._further(beside))

    def _noise(self, beside: Beside, gone: Gone) -> tuple[int, float]:
        """The number of the better noise beside some candidates, and the evidence there, up to a constant."""
        if (beside, gone) not in self._best:
            further, noises = self._further(beside), range(len(self.tracks))
            evidence = [self._without(gone, noise).whole(*further).evidence for noise in noises]
            best = int(np.argmax(evidence))
            self._best[beside, gone] = best, evidence[best]
        return self._best[beside, gone]

    def _without(self, gone: Gone, noise: int) -> Condensed:
        """The candidates' columns, with the model's own unknowns integrated out."""
        if (gone, noise) not in self._condensed:
            precision = self.priors.held(gone, self.model.widths)
            found = Condensed.of(self.tracks[noise], precision, self.priors.away, self.model.halves)
            self._condensed[gone, noise] = found
        return self._condensed[gone, noise]

    def _further(self, beside: Beside) -> tuple[Index, Array]:
        """Numbers of some candidates' columns among all candidates', and the precision of their priors."""
        columns = [np.arange(self._ends[one], self._ends[one + 1]) - self._own for one, _ in beside]
        sizes = [WIDTHS[width] * self._scales[one] for one, width in beside]
        return np.concatenate([np.zeros(0, dtype=np.intp), *columns]), np.concatenate([np.zeros(0), *sizes]) ** -2

    @cached_property
    def _centres(self) -> list[Array]:
        return [centres(candidate, self.model.fit.problem.model) for candidate in self.candidates]

    @cached_property
    def _scales(self) -> list[Array]:
        return [scales(candidate) for candidate in self.candidates]

    @cached_property
    def _ends(self) -> Index:
        return self._own + np.cumsum([0, *(len(candidate.strengths) for candidate in self.candidates)])

    def _posterior(self, beside: Beside, gone: Gone = ()) -> Posterior:
        """Of the model's own unknowns, then of some candidates' strengths."""
        columns, precision = self._further(beside)
        total = self.tracks[self._noise(beside, gone)[0]].of(np.full(len(self.model.halves), True))
        listed = np.concatenate((np.arange(self._own), self._own + columns, [total.gram.shape[-1] - 1]))
        part = Reduced(total.constant, total.gram[:, listed[:, None], listed])
        whole = np.append(self.priors.held(gone, self.model.widths), precision)
        return posterior(part, whole, np.append(self.priors.away, np.zeros(len(columns))))


@dataclass(frozen=True)
class _Gain:
    """Logarithm of the evidence over that without a candidate, and the number of its most probable width."""

    gain: float
    width: int


def _beyond_parts(odds: _Odds, known: _Odds) -> dict[tuple[int, ...], float]:
    """The sets that are more probable than all known ones with one candidate less."""
    parts = {frozenset(chosen): value for chosen, value in known.items()}
    return {c: o for c, o in odds.items() if o > max(parts.get(frozenset(c) - {one}, -np.inf) for one in c)}
