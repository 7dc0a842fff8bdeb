"""Prior odds of effects, the heavy-tailed prior of their strengths, and the normal priors of all unknowns of a fit.

A strength is normal about absence with a width that is itself unknown, so that no strength is forbidden.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from ballfg.arrays import Array, Index
from ballfg.diagnosis.evidence.likelihood import Posterior, Reduced, posterior
from ballfg.diagnosis.evidence.rows import USUAL, Patterns
from ballfg.diagnosis.fit.free import spread
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import TWINS, Hypothesis
from ballfg.diagnosis.hypotheses.varying import Varying, varied
from ballfg.dynamics import AnalyticModel

WIDTHS: Final = (0.0625, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Widths of the prior, in usual strengths, each as probable as the others."""
THERE: Final = 0.05  # Prior probability that an effect of the catalogue is there: one or two of some thirty
VARIES: Final = 0.01  # Prior probability that an effect differs between tracks in some way


def scales(hypothesis: Hypothesis) -> Array:
    """(p,) usual size of each strength, in its unit; a prior standard deviation if the effect states none."""
    usual = hypothesis.effect.usual
    if usual is None:
        return np.array([spread(hypothesis.coefficients[name]) for name in hypothesis.strengths])
    largest = max(map(abs, usual.change.values()))
    return np.array([abs(usual.change.get(varied(name), largest)) for name in hypothesis.strengths])


def centres(hypothesis: Hypothesis, model: AnalyticModel) -> Array:
    """(p,) where the prior of each strength is: absence, or what the model states of g, which it states as exact."""
    stated = dict(model.named_parameters())
    listed = zip(hypothesis.strengths, hypothesis.columns, strict=True)
    found = [(hypothesis.coefficients[name], column) for name, column in listed]
    return np.array([float(stated[n]) if c.sigma == 0.0 and n in stated else float(c.absent or 0.0) for c, n in found])


def log_odds(hypotheses: Sequence[Hypothesis], nameless: bool = False) -> float:
    """Logarithm of the prior odds of a model with these effects to one without any; nameless: and patterns.

    An effect counts for all that do exactly the same.
    """
    chances = [VARIES if isinstance(h, Varying) else THERE * (1 + len(TWINS.get(h.name, ()))) for h in hypotheses]
    return float(sum(np.log(p / (1.0 - p)) for p in [*chances, *[THERE] * nameless]))


def choice_odds(hypotheses: Sequence[Hypothesis]) -> float:
    """Logarithm of the prior probability of the shapes, among all those that were possible."""
    return -float(sum(np.log(h.choices) for h in hypotheses))


def within(hypothesis: Hypothesis, centre: Array, mean: Array, sigmas: Array, width: float) -> float:
    """Logarithm of the share of a normal posterior inside the bounds of the strengths, over that of their prior.

    A strength that would be most probable beyond a bound of physics explains less than the linear model says.

    Args: centre: (p,) of the prior.  mean, sigmas: (p,) of the strengths.  width: of the prior, in usual strengths.
    """
    free = hypothesis.free()
    listed = [free[name] for name in hypothesis.columns]
    low, high = (np.array([getattr(c, end) for c in listed]) for end in ("low", "high"))
    spreads = width * scales(hypothesis)
    after = _inside((low - mean) / sigmas, (high - mean) / sigmas)
    return float((after - _inside((low - centre) / spreads, (high - centre) / spreads)).sum())


def _inside(low: Array, high: Array) -> Array:
    """Logarithm of a standard normal's probability between bounds, exact in both tails."""
    flipped = low > 0.0
    near, far = np.where(flipped, -low, high), np.where(flipped, -high, low)
    return np.asarray(special.log_ndtr(near) + np.log1p(-np.exp(special.log_ndtr(far) - special.log_ndtr(near))))


MIDDLE: Final = WIDTHS.index(1.0)
HELD: Final = 1e-5  # Width of the prior of strengths that are held, in usual strengths
WIDTH_ROUNDS: Final = 2  # Number of turns in which each effect gets its most probable width


@dataclass(frozen=True)
class Priors:
    """Normal priors of the common unknowns of a fit, with widths for the strengths of its named effects."""

    base: Array  # (c,) precision of the others, zero for strengths
    away: Array  # (c,) prior mean less present value
    places: tuple[Index, ...]
    """Where the strengths of each effect, then those of each block of patterns, are."""
    sizes: tuple[Array, ...]  # Their usual sizes

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
