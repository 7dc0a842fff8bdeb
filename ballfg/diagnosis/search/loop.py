"""Closing the loop: fit, test, add what is lacking, and again, until nothing more helps; then say what remains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from ballfg.diagnosis.fit.fit import fit, followed, start_from
from ballfg.diagnosis.fit.holdout import Halves
from ballfg.diagnosis.fit.label_frames import frame_hypotheses
from ballfg.diagnosis.fit.problem import Fit, Problem
from ballfg.diagnosis.fit.process_noise import Predicting
from ballfg.diagnosis.fit.scene import scene_of
from ballfg.diagnosis.result import Candidate, Finding, Standing, Value
from ballfg.diagnosis.search.calibrated import values_of
from ballfg.diagnosis.search.candidates import (
    ALARM,
    Refit,
    Scored,
    explained,
    refit,
    refit_driven,
    refit_usual,
    score_all,
    shortlist,
)
from ballfg.diagnosis.search.evaluation import HeldOut, held_out
from ballfg.diagnosis.search.hypothesis import Hypothesis, declared_free, has_effect, hypotheses, with_effects
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.measurement.spin_labels import SpinLabelFrame

MOST_EFFECTS = 4
"""Effects that are added before the search ends; further ones would be found in what earlier wrong ones left."""
CONFIRMED = 0.05
"""An effect stays only if its gain on the judging half would arise by chance less often than this."""
LABELLED = 0.5
"""Share of flights whose spin must be labelled for an effect that multiplies spins to show in a score test."""
WORSE = 1.1
"""Ratio of prediction errors beyond which an effect is not added, however much better whole tracks are fitted with it:
a wrong name for what is lacking bends the motion to the samples, and predictions pay for it."""
BEYOND = 10.0
"""Prior standard deviations from its usual value within which a coefficient is plausible. A name that must be stretched
further (air that moves at 20 m/s through a part of the room) stands for something else."""
ALIKE = 6.0
"""BIC difference below which two effects cannot be told apart: odds of 20 to 1."""


@dataclass
class Search:
    """The state of the loop.

    Attributes:
        first: fit of the declared model.  declared: that model, as it predicts.
        fit: of the model so far.  predicting: that model, as it predicts.
        findings, rounds: as in `Diagnosis`.
    """

    first: Fit
    declared: Predicting
    fit: Fit
    predicting: Predicting
    findings: list[Finding] = field(default_factory=list)
    rounds: list[tuple[Candidate, ...]] = field(default_factory=list)


Predict = Callable[[Fit], Predicting]
"""A fitted model as it predicts."""


def search_effects(
    halves: Halves,
    model: AnalyticModel,
    catalogue: Sequence[type[Effect]],
    predict: Predict,
    watch: Callable[[str], None],
) -> Search:
    """Add effects until nothing helps.

    Args:
        halves: the data.  model: as declared.  catalogue: effects to look for.
        predict: makes a fit predict the tracks that it was fitted to.  watch: is told of progress.
    Returns: the search at its end.
    """
    declared = with_effects(model)
    problem = Problem(declared, followed(declared, halves.finding), declared_free(declared))
    watch(f"fitting the declared model to {len(halves.finding)} flights")
    first = fit(problem, *start_from(problem, halves.settings.spin_label_noise, halves.settings.spin_prior))
    predicting = predict(first)
    search = Search(first, predicting, first, predicting)
    while len(search.findings) < MOST_EFFECTS and _round(search, halves, catalogue, predict, watch):
        pass
    return search


def _round(
    search: Search,
    halves: Halves,
    catalogue: Sequence[type[Effect]],
    predict: Predict,
    watch: Callable[[str], None],
) -> bool:
    """One round; whether an effect was added."""
    number = len(search.rounds) + 1
    scored, refits = _tried(search.fit, catalogue, lambda line: watch(f"round {number}: {line}"))
    standing: dict[str, Standing] = {}
    winner = _confirmed(search, refits, halves, predict, standing)
    added = "nothing helps"
    if winner is not None:
        name = winner.refit.scored.hypothesis.name
        alike = tuple(
            r.scored.hypothesis.name
            for r in refits
            if r.scored.hypothesis.name not in (name, *standing) and r.delta_bic - winner.refit.delta_bic < ALIKE
        )
        standing |= dict.fromkeys(alike, Standing.ALIKE) | {name: Standing.ADDED}
        search.findings.append(_finding(winner, alike))
        search.fit, search.predicting = winner.settled, winner.predicting
        added = f"{name} added"
    search.rounds.append(_ranking(scored, refits, standing))
    watch(f"round {number}: {added}")
    return winner is not None


def _tried(
    before: Fit, catalogue: Sequence[type[Effect]], tell: Callable[[str], None]
) -> tuple[list[Scored], list[Refit]]:
    """Every hypothesis, the one that explains most first; refits of those that call, the best first."""
    model = before.problem.model
    assert isinstance(model, AnalyticModel)
    listed = hypotheses(model, scene_of(before), catalogue)
    candidates = [h for h in listed if not set(h.columns) & set(before.problem.free)]
    tell(f"testing {len(candidates)} hypotheses")
    unknown = before.problem.stretches.labelled.mean() < LABELLED
    driven = [h for h in candidates if h.effect.multiplies_spin and unknown]
    scored = score_all(before, [h for h in candidates if h not in driven])
    refits, leading = [], shortlist(scored)
    called = {candidate.hypothesis.name for candidate in leading}
    for candidate in leading:
        tell(f"fitting with {candidate.hypothesis.name}")
        refits += [refit(before, shaped) for shaped in _shaped(before, candidate)]
    for place, candidate in enumerate(scored):
        if candidate.hypothesis.name in called or not _left_out(model, candidate.hypothesis):
            continue
        tell(f"fitting with {candidate.hypothesis.name}, which balls usually have")
        fitted = refit_usual(before, candidate.hypothesis)
        if fitted.scored.p_value < ALARM:
            scored[place] = fitted.scored
            refits.append(fitted)
    for hypothesis in driven:
        tell(f"fitting with {hypothesis.name} and spins that nobody labelled")
        fitted = refit_driven(before, hypothesis)
        scored.append(fitted.scored)
        refits += [fitted] if fitted.scored.p_value < ALARM else []
    return sorted(scored, key=explained, reverse=True), sorted(refits, key=lambda r: r.delta_bic)


def _left_out(model: AnalyticModel, hypothesis: Hypothesis) -> bool:
    """Whether balls usually have the effect and the model has not."""
    return hypothesis.usual and not has_effect(model, hypothesis.name)


def _shaped(before: Fit, scored: Scored) -> list[Scored]:
    """What to refit for a hypothesis: itself, or the frames that come into question."""
    if scored.hypothesis.effect is not SpinLabelFrame:
        return [scored]
    frames = frame_hypotheses(before, scored.hypothesis)
    return [Scored(frame, None, scored.p_value) for frame in frames]


@dataclass(frozen=True)
class _Confirmed:
    """A refit that helps on the judging half, its noise settled, and as it predicts."""

    refit: Refit
    evidence: HeldOut
    settled: Fit
    predicting: Predicting


def _confirmed(
    search: Search, refits: Sequence[Refit], halves: Halves, predict: Predict, standing: dict[str, Standing]
) -> _Confirmed | None:
    """The best plausible refit that helps on the judging half and predicts no worse; `standing` tells of the others."""
    most = WORSE * search.predicting.errors.prediction_rmse_mm
    for candidate in refits:
        if candidate.delta_bic >= 0.0:
            break
        name = candidate.scored.hypothesis.name
        evidence = held_out(search.fit, candidate.fit, halves.judging)
        if evidence.p_value >= CONFIRMED:
            standing[name] = Standing.NOT_HELPFUL
            continue
        settled = fit(candidate.fit.problem, candidate.fit.unknowns, candidate.fit.noise)
        if candidate.scored.hypothesis.strain(settled.unknowns.values) > BEYOND:
            standing[name] = Standing.IMPLAUSIBLE
            continue
        predicting = predict(settled)
        if predicting.errors.prediction_rmse_mm <= most:
            return _Confirmed(candidate, evidence, settled, predicting)
        standing[name] = Standing.MISLEADING
    return None


def _finding(winner: _Confirmed, alike: tuple[str, ...]) -> Finding:
    hypothesis, settled = winner.refit.scored.hypothesis, winner.settled
    names = {hypothesis.parameter(c.name): c.name for c in hypothesis.effect.coefficients}
    fitted = values_of(settled, [n for n in names if n in settled.problem.free], {})
    units = {c.name: c.unit for c in hypothesis.effect.coefficients}
    shaped = {n: c for n, c in names.items() if c in hypothesis.shape and n not in fitted}
    exact = {n: Value(hypothesis.shape[c], 0.0, units[c]) for n, c in shaped.items()}
    return Finding(
        name=hypothesis.name,
        kind=hypothesis.effect.kind,
        sentence=hypothesis.effect.sentence,
        decide=hypothesis.effect.decide,
        parameters={names[n]: value for n, value in (fitted | exact).items()},
        p_value=winner.refit.scored.p_value,
        delta_bic=winner.refit.delta_bic,
        indistinguishable_from=alike,
        held_out_gain=winner.evidence.gain,
        held_out_p=winner.evidence.p_value,
    )


def _ranking(
    scored: Sequence[Scored], refits: Sequence[Refit], standing: Mapping[str, Standing]
) -> tuple[Candidate, ...]:
    """One row an effect, its best shape, the one that explains most first."""
    refitted = {r.scored.hypothesis.name: r.delta_bic for r in refits}
    rows: dict[str, Candidate] = {}
    for candidate in scored:
        name = candidate.hypothesis.name
        if name not in rows:
            rows[name] = _row(candidate, refitted.get(name), standing.get(name))
    return tuple(rows.values())


def _row(scored: Scored, delta_bic: float | None, standing: Standing | None) -> Candidate:
    hypothesis, score = scored.hypothesis, scored.score
    listed = {c.name: c for c in hypothesis.effect.coefficients}
    if score is None:
        return Candidate(hypothesis.name, hypothesis.effect.kind, {}, 0.0, 1.0, None, Standing.INVISIBLE)
    estimate = {
        n: Value(float(v), float(s), listed[n].unit)
        for n, v, s in zip(hypothesis.strengths, score.estimate, score.sigma, strict=True)
    }
    if standing is None and delta_bic is not None:
        standing = Standing.WEAKER
    if standing is None:
        hidden = all(v.sigma > listed[n].sigma > 0.0 for n, v in estimate.items())
        standing = Standing.INVISIBLE if hidden else Standing.NOT_NEEDED
    return Candidate(
        hypothesis.name, hypothesis.effect.kind, estimate, score.explained, scored.p_value, delta_bic, standing
    )
