"""Weighs a fitted model: its noise, its evidence, and its density of tracks whose half it was not fitted to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from ballfg.arrays import Array, Mask
from ballfg.diagnosis.evidence.halves import unlike_halves
from ballfg.diagnosis.evidence.likelihood import Batches, Noise, Reduced, Weights, held_out, posterior
from ballfg.diagnosis.evidence.own import carried_over, most_probable
from ballfg.diagnosis.evidence.prior import WIDTHS, Priors, choice_odds, log_odds, within
from ballfg.diagnosis.evidence.rows import NAMELESS, Motion, Patterns, Rows, random_motion, rows_beside, scattering
from ballfg.diagnosis.evidence.sizes import (
    DAMPED,
    FIRST_DAMPING,
    HARDLY,
    Ahead,
    Sized,
    Start,
    begun,
    climbed,
    next_damping,
)
from ballfg.diagnosis.fit.fit import alike, followed, with_guesses
from ballfg.diagnosis.fit.free import OWN_AIR
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis

MOST_TURNS = 4  # Largest number of times that paths follow what the coefficients of each stretch differ by
HARDLY_MOVED = 0.1  # Largest change of such a difference, over its unit, that paths need not follow
MOST_STEPS = 12  # Largest number of steps from a deterministic fit to the most probable unknowns
WORTH_A_STEP = 0.5  # Least expected gain of a step, natural units


@dataclass(frozen=True)
class Strengths:
    """Posterior of an effect's strengths: means (p,) and covariance (p, p), by the order of its hypothesis."""

    mean: Array
    covariance: Array


@dataclass(frozen=True)
class Weight:
    """What decides about a model: as weighed, or as another one's linearisation foretells it."""

    evidence: float  # Logarithm, natural units, up to a constant that all models of the same tracks share
    odds: float  # Logarithm of the prior odds
    held_out: Array  # (t,) logarithm of the density of each track, with coefficients of the other half
    prior: float  # Logarithm of the density of all coefficients by their priors, over that at the priors' means

    @property
    def score(self) -> float:
        """Logarithm of the posterior odds, up to the constant of `evidence`."""
        return self.evidence + self.odds


@dataclass(frozen=True)
class Smaller(Weight):
    """What decides about a model without some effects of another, whose linearisation foretells it."""

    step: Array  # (c,) of the other one's common unknowns to the most probable ones where those effects are absent


@dataclass(frozen=True)
class Weighed(Weight):
    """A model with its evidence."""

    named: tuple[Hypothesis, ...]  # Effects added to the declared model
    fit: Fit  # To the tracks of both halves
    noise: Noise  # Sizes of its noise
    weights: tuple[Weights, ...]  # Robust weights, batch by batch
    widths: tuple[int, ...]  # Number of each effect's most probable prior width
    strengths: Mapping[str, Strengths]  # By name of the effect
    halves: Mask  # (t,) which half each track belongs to
    nameless: bool = False  # Whether it holds patterns without a name as well
    nested: Mapping[frozenset[str], Smaller] = field(default_factory=dict)
    """The weight of each smaller model, by its names, the rest linearised where it is."""
    neighbours: Mapping[frozenset[str], Weight] = field(default_factory=dict)
    """The same of models with a further effect, or with another one in place of one of its own."""
    sigmas: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the fit's coefficients, beside what differs from track to track."""
    scatter: Mapping[str, float] = field(default_factory=dict)  # What coefficients differ by from track to track

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects, with `NAMELESS` for patterns without a name."""
        return frozenset(h.name for h in self.named) | frozenset([NAMELESS] * self.nameless)

    @cached_property
    def alike(self) -> Fit:
        """Its fit without what tracks have of their own, from which refits start."""
        return alike(self.fit)

    @property
    def start(self) -> Start:
        """Where the noise of a similar model starts."""
        return Start(self.noise, self.weights)

    def without(self, gain: float) -> "Weighed":
        """With strengths where its fit has them, and less evidence, also of the models that it holds.

        Args: gain: what a step promises that leads nowhere.
        """
        values = self.fit.unknowns.values
        own = {h.name: np.array([values[column] for column in h.columns]) for h in self.named}
        strengths = {name: replace(found, mean=own[name]) for name, found in self.strengths.items()}
        nested = {names: replace(weight, evidence=weight.evidence - gain) for names, weight in self.nested.items()}
        return replace(self, evidence=self.evidence - gain, strengths=strengths, nested=nested)


def weigh(fit: Fit, named: Sequence[Hypothesis] = (), *, nameless: bool = False) -> Weighed:
    """The evidence of a fitted model, with the sizes of its noise.

    Args:
        fit: to all tracks.
        named: effects in the fit that the declared model lacks; their strengths get the priors of effects.
        nameless: with patterns without a name beside them.
    Returns: the model with its evidence; ratios of evidences compare models of the same stretches.
    """
    patterns = Patterns.of(fit) if nameless else None
    own = {name for h in named for name in h.free()}
    motion = random_motion(fit, [name for name in scattering(fit) if name not in own or name in OWN_AIR])
    return weighed(fit, named, motion, unlike_halves(fit), patterns=patterns)


def weighed(
    fit: Fit,
    named: Sequence[Hypothesis],
    motion: Motion,
    halves: Mask,
    like: Weighed | None = None,
    patterns: Patterns | None = None,
) -> Weighed:
    """Weighs a model at the most probable values of its unknowns.

    A deterministic fit ends where the model alone comes closest to the samples; beside random motion other values are
    more probable. From the fit on, the common unknowns follow the likelihood. First states and random motion are
    integrated out about the path that comes closest to the samples: about another one, whose distance the motion would
    bridge, flights and bounces are far from linear.

    Args: fit: to the tracks of both halves.  motion: random columns of this or a similar model.  halves: (t,) in the
        order of the fit's tracks (`unlike_halves`).  like: a similar model.  patterns: of this or a similar model.
    """
    with np.errstate(invalid="ignore"):  # differences of models without a density: they lose to all others
        question = _Question(named, motion, halves, patterns)
        point, (found, ahead, density) = question.begun(fit, like)
        if question.nameless:  # without patterns the path would leave the samples; noise and widths need a second turn
            return question.at(point.begun_at((found.start,)), found.widths)[0]
        for _ in range(MOST_TURNS):
            turned = question.turned(point, found)
            if turned is None:
                break
            point, (found, ahead, density) = turned
        for _ in range(MOST_STEPS):
            moved = question.moved(point, found, ahead, density)
            if moved is None:
                break
            point, damping = moved
            found, ahead, density = question.at(point, damping=damping)
        return found.without(ahead.gain) if ahead.gain > WORTH_A_STEP else found


@dataclass(frozen=True)
class _Point:
    """A fit with its rows, beside patterns without a name if the question has them, and the priors there.

    Its noise is sought from the sizes with which the starts, as of `settled`, begin.
    """

    fit: Fit
    rows: Sequence[Rows]
    priors: Priors
    starts: Sequence[Sized] = ()

    def begun_at(self, starts: Sequence[Start | None]) -> "_Point":
        """The point with these starts."""
        return replace(self, starts=[begun(self.rows, start) for start in starts])

    @property
    def own(self) -> int:
        """Number of the common unknowns that the fit has; those of patterns come after them."""
        return len(self.fit.problem.common_precision)


_At = tuple[Weighed, Ahead, float]


@dataclass(frozen=True)
class _Question:
    """The arguments of `weighed` that stay the same at all values of the unknowns."""

    named: Sequence[Hypothesis]
    motion: Motion
    halves: Mask
    patterns: Patterns | None

    @property
    def nameless(self) -> bool:
        """Whether there are patterns without a name."""
        return self.patterns is not None

    def point(self, fit: Fit, starts: Sequence[Start | None]) -> _Point:
        fit = with_guesses(fit)
        rows = rows_beside(fit, self.motion, self.patterns)
        return _Point(fit, rows, Priors.of(fit, self.named, self.patterns)).begun_at(starts)

    def at(self, point: _Point, widths: Sequence[int] = (), damping: float = 0.0) -> _At:
        """The model at the unknowns of a point, the way to more probable ones, and the density as in `_density`.

        Args: widths: of the effects, then of the patterns, of a similar model.  damping: of the next step.
        """
        fit, priors = point.fit, point.priors
        own, effects = point.own, [h for h in self.named if h.strengths]
        of_patterns = list(widths[len(effects) :]) or [0] * (len(priors.places) - len(effects))
        first = priors.precision([len(WIDTHS) - 1] * len(effects) + of_patterns)
        likelihood, noise = climbed(point.starts, first, priors.away, own)
        total = likelihood.reduced(noise)[0].by_track(fit.problem.stretches.track)
        whole = total.of(np.full(len(self.halves), True))
        best, mixed = priors.widths(whole)
        result = priors.posterior(whole, best)
        strengths, values = {}, np.array([fit.unknowns.values[name] for name in fit.problem.free])
        for number, (hypothesis, place) in enumerate(zip(effects, priors.places, strict=False)):
            found = Strengths(values[place] + result.mean[place], result.covariance[np.ix_(place, place)])
            sigmas = np.sqrt(np.diagonal(found.covariance))
            centre = values[place] + priors.away[place]
            mixed[number] += within(hypothesis, centre, found.mean, sigmas, WIDTHS[best[number]])
            strengths[hypothesis.name] = found
        evidence = result.evidence + sum(mixed) + choice_odds(self.named)
        weighed = Weighed(
            evidence if np.isfinite(evidence) else -np.inf,
            log_odds(self.named, self.nameless),
            held_out(total, priors.precision(best), priors.away, self.halves),
            result.prior,
            tuple(self.named),
            replace(fit),  # without what can be computed again: a search keeps dozens of models
            noise,
            likelihood.weights,
            tuple(best),
            strengths,
            self.halves,
            self.nameless,
            self._nested(priors, total, best, mixed),
            sigmas=dict(zip(fit.problem.free, np.sqrt(np.diagonal(result.covariance)).tolist(), strict=False)),
            scatter=self.motion.scatter(noise.random),
        )
        return weighed, replace(Ahead.of(fit, result), damping=damping), result.held(own).evidence

    def moved(self, point: _Point, model: Weighed, ahead: Ahead, before: float) -> tuple[_Point, float] | None:
        """The point after a step to more probable unknowns, and the damping of the next; None if none is worth it.

        A step may leave the linear range: where samples cannot tell a clock from gravity, say, or hardly show spins.
        Damped, it stays among what they show well.

        Args: before: the density at the point.
        """
        damping = ahead.damping
        while True:
            step, promised = ahead.step(damping)
            if promised < WORTH_A_STEP:
                return None
            fit = followed(point.fit, replace(point.fit.stepped(step), own=self._own(point, model, step)))
            after = self.point(fit, (model.start,)) if np.isfinite(fit.cost) else None
            density = -np.inf if after is None else self._density(after, model.widths)
            share = (density - before) / promised
            if after is not None and share > HARDLY:
                return after, next_damping(damping, share)
            damping = max(FIRST_DAMPING, DAMPED * damping)

    def begun(self, fit: Fit, like: Weighed | None) -> tuple[_Point, _At]:
        """The more probable of two beginnings: tracks that are all alike, and what they have of their own by another.

        Args: like: the other, similar model.
        """
        own = {} if like is None else carried_over(like.fit, like.named, fit, self.named)
        starts = [None] if like is None else [like.start] if own else [like.start, None]
        points = [self.point(self._about(fit, own), starts)]
        if own:
            points.append(self.point(self._about(fit, {}), [None]))
        found = [(point, self.at(point)) for point in points]
        return max(found, key=lambda one: one[1][0].evidence)

    def turned(self, point: _Point, model: Weighed) -> tuple[_Point, _At] | None:
        """A more probable model, about the paths with what coefficients of each stretch most probably differ by.

        Half of the way leads to one where the whole leaves the linear range; None if neither does.
        """
        before = point.fit.unknowns.own
        moves = {n: value - before.get(n, 0.0) for n, value in self._own(point, model, np.zeros(point.own)).items()}
        away = [np.abs(moves[name]).max() / unit for name, unit in self.motion.spread.items()]
        if max(away, default=0.0) < HARDLY_MOVED:
            return None
        for share in (1.0, 0.5):
            fit = self._about(point.fit, {name: before.get(name, 0.0) + share * move for name, move in moves.items()})
            after = self.point(fit, [model.start])
            found = self.at(after)
            if found[0].evidence > model.evidence:
                return after, found
        return None

    def _own(self, point: _Point, model: Weighed, step: Array) -> dict[str, Array]:
        return most_probable(point.fit, Batches.of(point.rows, model.weights), model.noise, self.motion, step)

    @staticmethod
    def _about(fit: Fit, own: Mapping[str, Array]) -> Fit:
        """The fit with what stretches have of their own; the fit itself if paths then miss their contacts."""
        closest = followed(fit, replace(fit.unknowns, own=own))
        return closest if np.isfinite(closest.cost) else fit

    def _density(self, point: _Point, widths: Sequence[int]) -> float:
        """Logarithm of the density at the unknowns of a point, up to a constant, where its noise begins.

        The evidence is what it would be at the end of the step from there, if that were linear.
        """
        ((likelihood, noise),) = point.starts
        return point.priors.posterior(likelihood.reduced(noise)[0], widths).held().evidence

    def _nested(
        self, priors: Priors, tracks: Reduced, widths: Sequence[int], mixed: Sequence[float]
    ) -> dict[frozenset[str], Smaller]:
        """Weights of all models with some of the effects; strengths of the others are held where they are absent."""
        found, effects = {}, [h for h in self.named if h.strengths]
        whole = tracks.of(np.full(len(self.halves), True))
        for count in range(1, len(effects) + 1):
            for gone in combinations(range(len(effects)), count):
                rest = [h for h in self.named if h not in [effects[place] for place in gone]]
                if any(effects[place].effect.name in h.effect.needs for place in gone for h in rest):
                    continue
                precision = priors.held(gone, widths)
                held = posterior(whole, precision, priors.away)
                evidence = held.evidence + sum(mixed) - sum(mixed[place] for place in gone) + choice_odds(rest)
                names = frozenset(h.name for h in rest) | frozenset([NAMELESS] * self.nameless)
                density = held_out(tracks, precision, priors.away, self.halves)
                found[names] = Smaller(evidence, log_odds(rest, self.nameless), density, held.prior, held.mean)
        return found
