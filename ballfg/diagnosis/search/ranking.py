"""Reports a search round in words and numbers: the added effect, the ranking of all candidates, implausible values."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy import stats

from ballfg.diagnosis.evidence.odds import Odds
from ballfg.diagnosis.evidence.weighed import Weighed
from ballfg.diagnosis.fit.fit import values_of
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import TWINS, Hypothesis
from ballfg.diagnosis.result import Candidate, Finding, Outcome, Value
from ballfg.diagnosis.search.refits import Refit
from ballfg.diagnosis.search.score import ALARM, Scored
from ballfg.dynamics import EFFECTS
from ballfg.dynamics.effect import Coefficient, Range
from ballfg.tracks import TABLE_TENNIS


def finding_of(
    hypothesis: Hypothesis, model: Weighed, without: Weighed, odds: Odds, scored: Sequence[Scored]
) -> Finding:
    """A named effect with its evidence.

    Args: model, without: the most probable model, and the same without the effect.  odds: of all models.  scored: of
        the round that added it.
    """
    values = fitted_values(model.fit, hypothesis)
    if hypothesis.name in model.strengths and not hypothesis.deviations():
        found = model.strengths[hypothesis.name]
        sigmas = np.sqrt(np.diagonal(found.covariance)).tolist()
        listed = zip(hypothesis.strengths, found.mean.tolist(), sigmas, strict=True)
        values |= {name: replace(values[name], value=value, sigma=sigma) for name, value, sigma in listed}
    gains = model.held_out - without.held_out
    error = gains.std(ddof=1) / np.sqrt(len(gains))
    alike = odds.alike(hypothesis.name, model.names)
    return Finding(
        name=hypothesis.name,
        kind=hypothesis.effect.kind,
        sentence=hypothesis.effect.sentence,
        decide=hypothesis.effect.decide,
        parameters=values,
        p_value=_by_chance(hypothesis, model.evidence - without.evidence, scored),
        delta_bic=-2.0 * (model.evidence - without.evidence),
        indistinguishable_from=(*TWINS.get(hypothesis.name, ()), *alike),
        held_out_gain=float(gains.mean()),
        held_out_p=float(stats.norm.sf(gains.mean() / error)),
        probability=odds.of(hypothesis.name),
        together=odds.together(hypothesis.name, model.names),
        evidence=model.evidence - without.evidence,
        usual=unusual(hypothesis, values),
    )


def _by_chance(hypothesis: Hypothesis, evidence: float, scored: Sequence[Scored]) -> float:
    """The probability of a trace so strong by chance, as its score test says.

    If other effects hide it from the test, its evidence beside them counts as a likelihood ratio, the least it can be.
    """
    own = next((s for s in scored if s.hypothesis.name == hypothesis.name), None)
    if own is None:
        return 1.0
    ratio = float(stats.chi2.sf(2.0 * max(evidence, 0.0), max(len(hypothesis.strengths), 1)))
    return min(own.p_value, ratio * own.tested)


def unusual(hypothesis: Hypothesis, values: Mapping[str, Value]) -> str:
    """Words on strengths outside of the usual range; empty if they are inside."""
    known = hypothesis.effect.plausible
    if known is None:
        return ""
    names = [n for n in hypothesis.strengths if not known.low <= values[n].value <= known.high]
    if not names:
        return ""
    told = ", ".join(f"{n} = {values[n].value:.3g} {values[n].unit}" for n in names)
    return f"{told}: usually between {known.low:g} and {known.high:g} ({known.source})"


def fitted_values(fit: Fit, hypothesis: Hypothesis) -> dict[str, Value]:
    """The fitted coefficients of an effect, and the fixed ones of its shape."""
    names = {hypothesis.parameter(name): name for name in hypothesis.coefficients}
    values = values_of(fit, [name for name in names if name in fit.problem.free], {})
    return hypothesis.reported(fit, {names[name]: value for name, value in values.items()})


def ranking(
    scored: Sequence[Scored], refits: Sequence[Refit], added: Sequence[str], odds: Odds
) -> tuple[Candidate, ...]:
    """One row per effect in its best shape, sorted by explained residual."""
    outcomes = dict.fromkeys(added, Outcome.ADDED)
    refitted = {r.name: r.delta_bic for r in refits if not r.beside}
    best: dict[str, Scored] = {}
    for candidate in scored:
        best.setdefault(candidate.hypothesis.name, candidate)
    return tuple(replace(_row(s, refitted.get(n), outcomes.get(n)), probability=odds.of(n)) for n, s in best.items())


def _row(scored: Scored, delta_bic: float | None, outcome: Outcome | None) -> Candidate:
    hypothesis, score, kind = scored.hypothesis, scored.score, scored.hypothesis.effect.kind
    if score is None:
        return Candidate(hypothesis.name, kind, {}, 0.0, 1.0, None, Outcome.INVISIBLE)
    listed = [hypothesis.coefficients[n] for n in hypothesis.strengths]
    estimate = {
        c.name: Value(float(v), float(s), c.unit) for c, v, s in zip(listed, score.estimate, score.sigma, strict=True)
    }
    least = dict(zip(estimate, score.seen_from(ALARM / scored.tested).tolist(), strict=True))
    if outcome is None and delta_bic is not None:
        outcome = Outcome.WEAKER
    if outcome is None:
        hidden = all(s > c.sigma > 0.0 for c, s in zip(listed, score.sigma, strict=True))
        outcome = Outcome.INVISIBLE if hidden else Outcome.NOT_NEEDED
    return Candidate(hypothesis.name, kind, estimate, score.explained, scored.p_value, delta_bic, outcome, least)


NEAR: Final = 0.15  # Relative. Largest difference from the radius of a table-tennis ball, for these ranges to apply
MARGIN: Final = 0.1  # Share of a range by which a fitted value may lie outside of it
SIGMAS: Final = 3.0  # Largest distance of a plausible value from its range, in standard deviations of the value


def range_of(name: str, radius: float) -> Range | None:
    """The plausible range of a coefficient, for a ball of some radius in m; None if unknown."""
    effect, _, coefficient = name.partition(".")
    known = EFFECTS.get(effect)
    if known is None or abs(radius / TABLE_TENNIS.radius - 1.0) > NEAR:
        return None
    return known.plausible if coefficient in {c.name for c in known.coefficients if c.absent is not None} else None


def implausible(name: str, value: Value, radius: float) -> str:
    """The reason why a fitted value is implausible; empty if it is plausible, or without a known range.

    Args: name: of effect and coefficient, `wind.x`.  radius: of the ball, m.
    """
    known = range_of(name, radius)
    if known is None:
        return ""
    slack = MARGIN * (known.high - known.low)
    if value.sigma > 0.0:
        slack = min(slack, SIGMAS * value.sigma)
    if known.low - slack <= value.value <= known.high + slack:
        return ""
    unit = "" if value.unit == "1" else f" {value.unit}"
    return f"{name} = {value.value:.3g}{unit} lies outside of {known.low:g} to {known.high:g}{unit} ({known.source})"


def at_bound(name: str, value: Value, coefficient: Coefficient) -> str:
    """The finding that tracks pull a coefficient to its bound; empty if it is inside, or held there by the model.

    Args: name: of effect and coefficient.  coefficient: as declared, with its bounds.
    """
    if value.value not in (coefficient.low, coefficient.high) or value.value == value.declared:
        return ""
    unit = "" if value.unit == "1" else f" {value.unit}"
    return f"{name} = {value.value:.3g}{unit} is the bound of that coefficient: the tracks ask for more"
