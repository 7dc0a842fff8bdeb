"""The normal priors of all common unknowns of a fit, with the most probable width for each effect's strengths."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from ballfg.arrays import Array, Index
from ballfg.diagnosis.evidence.likelihood import Posterior, Reduced, posterior
from ballfg.diagnosis.evidence.nameless import USUAL, Patterns
from ballfg.diagnosis.evidence.prior import WIDTHS, centres, scales
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis

MIDDLE: Final = WIDTHS.index(1.0)
HELD: Final = 1e-5
"""Width of the prior of strengths that are held, in usual strengths."""
WIDTH_ROUNDS: Final = 2
"""Number of turns in which each effect gets its most probable width."""


@dataclass(frozen=True)
class Priors:
    """Normal priors of the common unknowns of a fit, with widths for the strengths of its named effects.

    Attributes:
        base: (c,) precision of the others, zero for strengths.
        away: (c,) prior mean less present value.
        places, sizes: for each effect, then for each block of patterns, where its strengths are and their usual sizes.
    """

    base: Array
    away: Array
    places: tuple[Index, ...]
    sizes: tuple[Array, ...]

    @classmethod
    def of(cls, fit: Fit, named: Sequence[Hypothesis], patterns: Patterns | None = None) -> "Priors":
        """The priors at a fit, beside patterns."""
        problem, listed = fit.problem, list(fit.problem.free)
        with_strengths = [h for h in named if h.strengths]
        places = tuple(np.array([listed.index(c) for c in h.columns]) for h in with_strengths)
        values = np.array([fit.unknowns.values[name] for name in listed])
        middles = problem.centres.copy()
        for hypothesis, place in zip(with_strengths, places, strict=True):
            middles[place] = centres(hypothesis, problem.model)
        base = problem.common_precision.copy()
        for place in places:
            base[place] = 0.0
        away = np.concatenate((middles - values, -fit.unknowns.launcher.ravel()))
        sizes = tuple(scales(h) for h in with_strengths)
        if patterns is None:
            return cls(base, away, places, sizes)
        none = np.zeros(sum(len(block) for block in patterns.blocks))
        more = tuple(len(base) + block for block in patterns.blocks)
        usual = tuple(np.full(len(block), USUAL) for block in patterns.blocks)
        return cls(np.append(base, none), np.append(away, none), (*places, *more), (*sizes, *usual))

    def precision(self, widths: Sequence[int]) -> Array:
        """(c,) with one of `WIDTHS` for each effect."""
        found = self.base.copy()
        for place, size, width in zip(self.places, self.sizes, widths, strict=True):
            found[place] = (WIDTHS[width] * size) ** -2
        return found

    def widths(self, reduced: Reduced) -> tuple[list[int], list[float]]:
        """The most probable widths, and for each the logarithm of the mean evidence over all less that at the best.

        Effects are taken one after the other, the others at their best width.
        """
        chosen, mixed = [MIDDLE] * len(self.places), [0.0] * len(self.places)
        for _ in range(WIDTH_ROUNDS):
            for effect in range(len(chosen)):
                every = ([*chosen[:effect], width, *chosen[effect + 1 :]] for width in range(len(WIDTHS)))
                evidence = np.array([self.posterior(reduced, widths).evidence for widths in every])
                chosen[effect] = int(evidence.argmax())
                mixed[effect] = float(special.logsumexp(evidence - evidence.max()) - np.log(len(WIDTHS)))
        return chosen, mixed

    def posterior(self, reduced: Reduced, widths: Sequence[int]) -> Posterior:
        """The posterior of all common unknowns."""
        return posterior(reduced, self.precision(widths), self.away)

    def held(self, effects: Sequence[int], widths: Sequence[int]) -> Array:
        """(c,) the precision that holds the strengths of some effects where they are absent."""
        precision = self.precision(widths)
        for effect in effects:
            precision[self.places[effect]] = (HELD * self.sizes[effect]) ** -2
        return precision
