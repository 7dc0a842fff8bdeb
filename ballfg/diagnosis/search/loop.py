"""The search loop: fit, test, add the effect that is lacking, and repeat until nothing more helps."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from ballfg.diagnosis.fit.fit import fit_model, fit_problem, values_of
from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Candidate, Finding, Outcome, Value
from ballfg.diagnosis.search.candidates import (
    ALARM,
    Refit,
    Scored,
    refit,
    refit_driven,
    refit_usual,
    score_all,
    shortlist,
)
from ballfg.diagnosis.search.evaluation import HeldOutGain, held_out_gain
from ballfg.diagnosis.search.hypothesis import has_effect, hypotheses, scene_of
from ballfg.diagnosis.search.label_frames import frame_hypotheses
from ballfg.diagnosis.search.process_noise import PredictiveModel
from ballfg.dynamics import AnalyticModel, Effect
from ballfg.dynamics.effects.measurement import SpinLabelFrame

MOST_EFFECTS = 4
"""Effects that are added before the search ends; further ones would be found in what earlier wrong ones left."""
CONFIRMED = 0.05
"""An effect stays only if its gain on the held-out half would arise by chance less often than this."""
LABELLED = 0.5
"""Share of flights whose spin must be labelled for an effect that multiplies spins to show in a score test."""
WORSE = 1.1
"""Ratio of prediction errors beyond which an effect is not added, however much better whole tracks are fitted with it:
a wrong name for a lacking effect bends the motion to the samples, and predictions get worse."""
PLAUSIBLE = 10.0
"""Prior standard deviations from its usual value within which a coefficient is plausible. An effect that must be
stronger than that (air that moves at 20 m/s through a part of the room) stands for something else."""
ALIKE = 6.0
"""BIC difference below which two effects cannot be told apart: odds of 20 to 1."""


@dataclass(frozen=True)
class Search:
    """State of the search after some rounds.

    Attributes:
        first, declared: fit of the declared model, and that model as it predicts.
        fit, predictive: the same of the model with the effects added so far.
        findings, rounds: as in `Diagnosis`.
    """

    first: Fit
    declared: PredictiveModel
    fit: Fit
    predictive: PredictiveModel
    findings: tuple[Finding, ...] = ()
    rounds: tuple[tuple[Candidate, ...], ...] = ()


@dataclass(frozen=True)
class _Confirmed:
    """A refit that helps on the held-out half; the same with its noise settled, and as it predicts."""

    refit: Refit
    evidence: HeldOutGain
    settled: Fit
    predictive: PredictiveModel


@dataclass(frozen=True)
class SearchLoop:
    """The inputs of a search, the same in every round.

    `predictive` gives a fitted model the process noise that predicts the tracks which it was fitted to; `watch` is told
    of progress, in lines.
    """

    holdout: Holdout
    catalogue: Sequence[type[Effect]]
    predictive: Callable[[Fit], PredictiveModel]
    watch: Callable[[str], None]
    plausible: float = PLAUSIBLE

    def run(self, model: AnalyticModel) -> Search:
        """Add effects to the declared model until none helps."""
        self.watch(f"fitting the declared model to {len(self.holdout.search)} flights")
        first = fit_model(model, self.holdout.search, self.holdout.settings)
        declared = self.predictive(first)
        search = Search(first, declared, first, declared)
        while len(search.findings) == len(search.rounds) < MOST_EFFECTS:  # each round so far has added an effect
            search = self._round(search)
        return search

    def _round(self, search: Search) -> Search:
        """The search after one more round."""
        number = len(search.rounds) + 1
        scored, refits = _tried(search.fit, self.catalogue, lambda line: self.watch(f"round {number}: {line}"))
        winner, outcomes = self._confirmed(search, refits)
        if winner is None:
            self.watch(f"round {number}: nothing helps")
            return replace(search, rounds=(*search.rounds, _ranking(scored, refits, outcomes)))
        name, limit = winner.refit.name, winner.refit.delta_bic + ALIKE
        alike = tuple(r.name for r in refits if r.name not in (name, *outcomes) and r.delta_bic < limit)
        outcomes |= dict.fromkeys(alike, Outcome.ALIKE) | {name: Outcome.ADDED}
        self.watch(f"round {number}: {name} added")
        return replace(
            search,
            fit=winner.settled,
            predictive=winner.predictive,
            findings=(*search.findings, _finding(winner, alike)),
            rounds=(*search.rounds, _ranking(scored, refits, outcomes)),
        )

    def _confirmed(self, search: Search, refits: Sequence[Refit]) -> tuple[_Confirmed | None, dict[str, Outcome]]:
        """The best plausible refit that helps on the held-out half and predicts no worse; outcomes of those before."""
        most = WORSE * search.predictive.errors.prediction_rmse_mm
        outcomes: dict[str, Outcome] = {}
        for candidate in refits:
            if candidate.delta_bic >= 0.0:
                break
            evidence = held_out_gain(search.fit, candidate.fit, self.holdout.held_out)
            if evidence.p_value >= CONFIRMED:
                outcomes[candidate.name] = Outcome.NOT_HELPFUL
                continue
            settled = fit_problem(candidate.fit.problem, candidate.fit.unknowns, candidate.fit.noise)
            if candidate.scored.hypothesis.strain(settled.unknowns.values) > self.plausible:
                outcomes[candidate.name] = Outcome.IMPLAUSIBLE
                continue
            predictive = self.predictive(settled)
            if predictive.errors.prediction_rmse_mm <= most:
                return _Confirmed(candidate, evidence, settled, predictive), outcomes
            outcomes[candidate.name] = Outcome.MISLEADING
        return None, outcomes


def _tried(
    before: Fit, catalogue: Sequence[type[Effect]], tell: Callable[[str], None]
) -> tuple[list[Scored], list[Refit]]:
    """Every hypothesis, the one that explains most first; and the refits, the best first."""
    model = before.problem.model
    listed = hypotheses(model, scene_of(before), catalogue)
    candidates = [h for h in listed if not set(h.columns) & set(before.problem.free)]
    tell(f"testing {len(candidates)} hypotheses")
    unlabelled = before.problem.stretches.labelled.mean() < LABELLED
    driven = [h for h in candidates if h.effect.multiplies_spin and unlabelled]
    scored = score_all(before, [h for h in candidates if h not in driven])
    leading, refits = shortlist(scored), []
    for candidate in leading:
        tell(f"fitting with {candidate.hypothesis.name}")
        shaped = [candidate]
        if candidate.hypothesis.effect is SpinLabelFrame:
            frames = frame_hypotheses(before, candidate.hypothesis)
            shaped = [Scored(frame, None, candidate.p_value) for frame in frames]
        refits += [refit(before, one) for one in shaped]
    called = {candidate.hypothesis.name for candidate in leading}
    for place, hypothesis in enumerate([s.hypothesis for s in scored]):
        if hypothesis.name in called or not hypothesis.usual or has_effect(model, hypothesis.name):
            continue
        tell(f"fitting with {hypothesis.name}, which balls usually have")
        fitted = refit_usual(before, hypothesis)
        if fitted.scored.p_value < ALARM:
            scored[place] = fitted.scored
            refits.append(fitted)
    for hypothesis in driven:
        tell(f"fitting with {hypothesis.name} and spins that nobody labelled")
        fitted = refit_driven(before, hypothesis)
        scored.append(fitted.scored)
        refits += [fitted] if fitted.scored.p_value < ALARM else []
    ranked = sorted(scored, key=lambda s: s.explained, reverse=True)
    return ranked, sorted(refits, key=lambda r: r.delta_bic)


def _finding(winner: _Confirmed, alike: tuple[str, ...]) -> Finding:
    hypothesis, settled = winner.refit.scored.hypothesis, winner.settled
    names = {hypothesis.parameter(name): name for name in hypothesis.coefficients}
    values = values_of(settled, [n for n in names if n in settled.problem.free], {})
    values |= {
        n: Value(hypothesis.shape[c], 0.0, hypothesis.coefficients[c].unit)
        for n, c in names.items()
        if c in hypothesis.shape and n not in values
    }
    return Finding(
        name=hypothesis.name,
        kind=hypothesis.effect.kind,
        sentence=hypothesis.effect.sentence,
        decide=hypothesis.effect.decide,
        parameters={names[n]: value for n, value in values.items()},
        p_value=winner.refit.scored.p_value,
        delta_bic=winner.refit.delta_bic,
        indistinguishable_from=alike,
        held_out_gain=winner.evidence.gain,
        held_out_p=winner.evidence.p_value,
    )


def _ranking(
    scored: Sequence[Scored], refits: Sequence[Refit], outcomes: Mapping[str, Outcome]
) -> tuple[Candidate, ...]:
    """One row an effect, its best shape, the one that explains most first."""
    refitted = {r.name: r.delta_bic for r in refits}
    best: dict[str, Scored] = {}
    for candidate in scored:
        best.setdefault(candidate.hypothesis.name, candidate)
    return tuple(_row(s, refitted.get(n), outcomes.get(n)) for n, s in best.items())


def _row(scored: Scored, delta_bic: float | None, outcome: Outcome | None) -> Candidate:
    hypothesis, score, kind = scored.hypothesis, scored.score, scored.hypothesis.effect.kind
    if score is None:
        return Candidate(hypothesis.name, kind, {}, 0.0, 1.0, None, Outcome.INVISIBLE)
    listed = [hypothesis.coefficients[n] for n in hypothesis.strengths]
    estimate = {
        c.name: Value(float(v), float(s), c.unit) for c, v, s in zip(listed, score.estimate, score.sigma, strict=True)
    }
    if outcome is None and delta_bic is not None:
        outcome = Outcome.WEAKER
    if outcome is None:
        hidden = all(s > c.sigma > 0.0 for c, s in zip(listed, score.sigma, strict=True))
        outcome = Outcome.INVISIBLE if hidden else Outcome.NOT_NEEDED
    return Candidate(hypothesis.name, kind, estimate, score.explained, scored.p_value, delta_bic, outcome)
