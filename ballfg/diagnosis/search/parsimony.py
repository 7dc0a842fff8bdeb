"""Tests whether an effect that fits better deserves a name.

A flexible effect fits almost any pattern a little. It is a name only if its own coefficients differ from zero, if both
halves of the tracks agree on them, and if the earlier effects are still needed beside it. Standard deviations here come
from the scatter of tracks, not from the stated noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import stats

from ballfg.arrays import Array
from ballfg.diagnosis.fit.fit import covariance_of, fit_problem, reachable
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.diagnosis.search.hypothesis import Hypothesis
from ballfg.diagnosis.search.plausible import SIGMAS
from ballfg.diagnosis.search.score import Score, score_tests
from ballfg.diagnosis.search.signatures import Signatures
from ballfg.diagnosis.search.state import without_named

LEAST_FREEDOM: Final = 2
"""Least degrees of freedom of a half, even with hardly more tracks than unknowns."""
CHANCE: Final = 2.0 * float(stats.norm.sf(SIGMAS))
"""The probability of `SIGMAS`, for groups of several coefficients."""


def own_scores(fit: Fit, named: Sequence[Hypothesis]) -> list[Score | None]:
    """Tests of a model's effects: the loss of fit without each of them, with all else free.

    Args: fit: with all of them in its model.  named: effects with strengths.
    Returns: for each its coefficients less their absent values, their standard deviations from the scatter of tracks,
        and the probability by chance; None for an effect that the tracks do not show.
    """
    return [_own_score(fit, hypothesis) for hypothesis in named]


def _own_score(fit: Fit, hypothesis: Hypothesis) -> Score | None:
    gram = fit.gram
    listed, precision = list(fit.problem.free), fit.problem.common_precision
    own = [listed.index(name) for name in hypothesis.columns]
    others = [number for number in range(len(precision)) if number not in own]
    absent = np.array([hypothesis.coefficients[n].absent for n in hypothesis.strengths], dtype=np.float64)
    strengths = np.array([fit.unknowns.values[name] for name in hypothesis.columns]) - absent
    total = gram.sum(axis=0)
    share = np.linalg.solve(total[np.ix_(others, others)] + np.diag(precision[others]), total[np.ix_(others, own)])
    without = np.eye(len(precision) + 1)  # to first order the residual of the best fit without the effect
    without[own, -1], without[others, -1] = strengths, -share @ strengths
    order = [*others, *own, len(precision)]
    turned = (without.T @ gram @ without)[:, order][:, :, order]
    return score_tests(Signatures(turned, precision[others], len(others)), [range(len(own))])[0]


@dataclass(frozen=True)
class Significance:
    """True if an effect by itself differs from absent, and the standard deviation (p,) of each of its strengths."""

    differs: bool
    sigmas: Array


def significance(fit: Fit, hypothesis: Hypothesis, first: Fit) -> Significance:
    """The significance of an effect's difference from absence: of its strengths together, and of a single one.

    Standard deviations are those of the noise or of the scatter of tracks, the larger of the two. A strongly nonlinear
    strength (a saturation) may be uncertain and yet far from zero. For a single strength the likelihood ratio against
    the fit without it therefore counts too, divided by the excess of the scatter over the noise.

    Args: fit: with the effect, which has strengths.  first: of the declared model, without the named effects.
    """
    covariance = covariance_of(fit, hypothesis.columns)
    noise = np.sqrt(np.diagonal(covariance))
    (score,) = own_scores(fit, [hypothesis])
    if score is None:
        return Significance(False, np.full(len(noise), np.inf))
    absent = np.array([hypothesis.coefficients[n].absent for n in hypothesis.strengths], dtype=np.float64)
    strengths = np.array([fit.unknowns.values[name] for name in hypothesis.columns]) - absent
    sigmas = np.maximum(noise, score.sigma)
    # the score leaves out directions without an effect, such as the same time offset of all axes
    differs = score.p_value <= CHANCE and bool((np.abs(score.estimate) > SIGMAS * score.sigma).any())
    if len(noise) > 1:
        # it thus leaves out the strength of an effect whose shape compensates any strength; the covariance does not
        seen = np.isfinite(score.sigma)
        excess = max(1.0, float((score.sigma[seen] / noise[seen]).max()))
        wald = float(strengths @ np.linalg.solve(covariance, strengths)) / excess**2
        return Significance(differs and float(stats.chi2.sf(wald, len(noise))) <= CHANCE, sigmas)
    if differs:
        return Significance(True, sigmas)
    gain = 2.0 * (without_named(fit, hypothesis, first).cost - fit.cost) * float((noise / sigmas)[0]) ** 2
    if gain < SIGMAS**2:
        return Significance(False, sigmas)
    return Significance(True, np.clip(np.abs(strengths) / np.sqrt(gain), noise, sigmas))


def insignificant(fit: Fit, named: Sequence[Hypothesis], first: Fit) -> list[Hypothesis]:
    """The effects of a model that do not differ from absent by themselves, except those that differ between tracks."""
    varying = {h.effect.name for h in named if h.deviations()}
    asked = [h for h in named if h.strengths and (h.deviations() or h.effect.name not in varying)]
    return [h for h in asked if not significance(fit, h, first).differs]


def halves_differ(fit: Fit, hypothesis: Hypothesis, held_out: Stretches) -> bool:
    """True if the held-out half gives other strengths of an effect than the search half of the fit.

    Args: fit: to the search half, with the effect.  held_out: stretches of the other half.
    """
    if not hypothesis.strengths:
        return False
    values = fit.unknowns.values
    stretches = reachable(fit.problem.model, held_out, fit.problem.by_stretch(values, held_out))
    unknowns = replace(fit.unknowns, starts=stretches.starts.numpy().copy())
    other = fit_problem(replace(fit.problem, stretches=stretches), unknowns, fit.noise, settle_noise=False)
    if not np.isfinite(other.cost):
        return False
    one, two = (own_scores(half, [hypothesis])[0] for half in (fit, other))
    if one is None or two is None:
        return False
    # in visible directions only: a common time offset of all axes is invisible and differs by chance
    difference = two.estimate - one.estimate
    tracks = np.array([len(np.unique(half.problem.stretches.track)) for half in (fit, other)])
    # the scatter of tracks is too small by the number of common unknowns fitted to the same tracks
    left = np.maximum(tracks - len(values), LEAST_FREEDOM)
    sigma = np.hypot(*(half.sigma * np.sqrt(n / m) for half, n, m in zip((one, two), tracks, left, strict=True)))
    freedom = int(left.sum())
    p_values = 2.0 * stats.t.sf(np.abs(difference) / sigma, freedom)
    return bool(p_values.min() * len(p_values) < CHANCE)
