"""The search loop: fit, test, add the effect that is lacking, and repeat until nothing more helps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from ballfg.diagnosis.fit.fit import fit_model, fit_problem
from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Candidate, Errors, Finding, Outcome, Refusal
from ballfg.diagnosis.search.candidates import (
    ALARM,
    Refit,
    Scored,
    delta_bic,
    refit,
    refit_driven,
    refit_usual,
    score_all,
    shortlist,
)
from ballfg.diagnosis.search.evaluation import HeldOutGain, held_out_gain
from ballfg.diagnosis.search.hypothesis import Hypothesis, has_effect, hypotheses, scene_of, without_effect
from ballfg.diagnosis.search.label_frames import frame_hypotheses
from ballfg.diagnosis.search.parsimony import halves_differ, insignificant
from ballfg.diagnosis.search.plausible import implausible
from ballfg.diagnosis.search.process_noise import PredictiveModel
from ballfg.diagnosis.search.ranking import NO_NAME, as_left, finding_of, fitted_values, ranking
from ballfg.dynamics import AnalyticModel, BallModel, Effect
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
        before, judged: prediction errors of both on the judging half.
        named: the effects added so far, in order.
        findings, rounds: as in `Diagnosis`.
        refused: by name, effects that fit better and are no names.
    """

    first: Fit
    declared: PredictiveModel
    fit: Fit
    predictive: PredictiveModel
    before: Errors
    judged: Errors
    named: tuple[Hypothesis, ...] = ()
    findings: tuple[Finding, ...] = ()
    rounds: tuple[tuple[Candidate, ...], ...] = ()
    refused: dict[str, Refusal] = field(default_factory=dict)


@dataclass(frozen=True)
class _Confirmed:
    """A refit that deserves a name.

    Attributes:
        refit: with the effect.
        evidence: its gain on the held-out half.
        kept: effects named before that stay.
        settled, predictive: the fit with its noise settled, and as it predicts.
        judged: errors of its predictions on the judging half.
    """

    refit: Refit
    evidence: HeldOutGain
    kept: tuple[Hypothesis, ...]
    settled: Fit
    predictive: PredictiveModel
    judged: Errors


@dataclass(frozen=True)
class SearchLoop:
    """The inputs of a search, the same in every round.

    `predictive` gives a fitted model the process noise that predicts the tracks which it was fitted to; `judge` gives
    the errors of its predictions on the judging half; `watch` is told of progress, in lines.
    """

    holdout: Holdout
    catalogue: Sequence[type[Effect]]
    predictive: Callable[[Fit], PredictiveModel]
    judge: Callable[[BallModel], Errors]
    watch: Callable[[str], None]
    plausible: float = PLAUSIBLE

    def run(self, model: AnalyticModel) -> Search:
        """Add effects to the declared model until none helps, then take out those without which it predicts better."""
        self.watch(f"fitting the declared model to {len(self.holdout.search)} flights")
        first = fit_model(model, self.holdout.search, self.holdout.settings)
        declared = self.predictive(first)
        judged = self.judge(declared.model)
        search, helped = Search(first, declared, first, declared, judged, judged), True
        while helped and len(search.rounds) < MOST_EFFECTS:
            search, helped = self._round(search)
        search = self._pruned(search)
        refused = {n: r for n, r in search.refused.items() if n not in {f.name for f in search.findings}}
        return replace(search, findings=as_left(search.findings, search.named, search.fit), refused=refused)

    def _round(self, search: Search) -> tuple[Search, bool]:
        """The search after one more round, and whether the round added an effect."""
        number = len(search.rounds) + 1
        scored, refits = _tried(search.fit, self.catalogue, lambda line: self.watch(f"round {number}: {line}"))
        outcomes: dict[str, Outcome] = {}
        winner, refused = self._confirmed(search, refits, outcomes)
        if winner is None:
            self.watch(f"round {number}: nothing helps")
            rounds = (*search.rounds, ranking(scored, refits, outcomes))
            return replace(search, rounds=rounds, refused=search.refused | refused), False
        name, limit = winner.refit.name, winner.refit.delta_bic + ALIKE
        near = [r for r in refits if r.name not in (name, *outcomes) and r.delta_bic < limit]
        alike = tuple(r.name for r in near if not self._implausible(r.scored.hypothesis, r.fit))
        outcomes |= dict.fromkeys(alike, Outcome.ALIKE) | {name: Outcome.ADDED}
        self.watch(f"round {number}: {name} added")
        kept = [f for f in search.findings if f.name in {h.name for h in winner.kept}]
        after = replace(
            search,
            fit=winner.settled,
            predictive=winner.predictive,
            judged=winner.judged,
            named=(*winner.kept, winner.refit.scored.hypothesis),
            findings=(*kept, finding_of(winner.refit, winner.settled, winner.evidence, alike)),
            rounds=(*search.rounds, ranking(scored, refits, outcomes)),
            refused=search.refused | refused,
        )
        return after, True

    def _confirmed(
        self, search: Search, refits: Sequence[Refit], outcomes: dict[str, Outcome]
    ) -> tuple[_Confirmed | None, dict[str, Refusal]]:
        """The best refit that deserves a name, and better ones that do not; fills in their outcomes."""
        refused: dict[str, Refusal] = {}
        for candidate in refits:
            if candidate.delta_bic >= 0.0:
                break
            examined = self._examined(search, candidate)
            if isinstance(examined, _Confirmed):
                return examined, refused
            outcomes[candidate.name] = examined
            if examined in NO_NAME:
                refused[candidate.name] = self._refusal(candidate, examined)
        return None, refused

    def _examined(self, search: Search, candidate: Refit) -> _Confirmed | Outcome:
        """A refit with all that confirms it, or the reason for which it is no name; cheap questions come first."""
        hypothesis = candidate.scored.hypothesis
        evidence = held_out_gain(search.fit, candidate.fit, self.holdout.held_out)
        if evidence.p_value >= CONFIRMED:
            return Outcome.NOT_HELPFUL
        settled = fit_problem(candidate.fit.problem, candidate.fit.unknowns, candidate.fit.noise)
        if self._implausible(hypothesis, settled):
            return Outcome.IMPLAUSIBLE
        idle = insignificant(settled, [*search.named, hypothesis])
        if hypothesis in idle:
            return Outcome.INSIGNIFICANT
        kept = tuple(h for h in search.named if h not in idle)
        if idle:
            alone = candidate.fit
            for other in idle:
                alone = _without(alone, other, search.first)
            if delta_bic(search.fit, alone) >= 0.0:
                return Outcome.SAME_PATTERN
            settled = fit_problem(alone.problem, alone.unknowns, alone.noise)
        if halves_differ(settled, hypothesis, self.holdout.held_out):
            return Outcome.CONTRADICTORY
        predictive = self.predictive(settled)
        if predictive.errors.prediction_rmse_mm > WORSE * search.predictive.errors.prediction_rmse_mm:
            return Outcome.MISLEADING
        judged = self.judge(predictive.model)
        if judged.prediction_rmse_mm > search.judged.prediction_rmse_mm:
            return Outcome.MISLEADING
        return _Confirmed(candidate, evidence, kept, settled, predictive, judged)

    def _implausible(self, hypothesis: Hypothesis, fit: Fit) -> str:
        """Why the fitted strengths of an effect are not plausible; empty if they are."""
        values = fitted_values(fit, hypothesis)
        radius = fit.problem.model.radius
        known = [implausible(f"{hypothesis.name}.{n}", values[n], radius) for n in hypothesis.strengths]
        if any(known):
            return next(text for text in known if text)
        if hypothesis.strain(fit.unknowns.values) > self.plausible:
            return f"that is more than {self.plausible:g} times as far from usual as is typical"
        return ""

    def _refusal(self, candidate: Refit, outcome: Outcome) -> Refusal:
        """An effect that fits better and is no name."""
        hypothesis = candidate.scored.hypothesis
        reason = self._implausible(hypothesis, candidate.fit) if outcome is Outcome.IMPLAUSIBLE else ""
        values = fitted_values(candidate.fit, hypothesis)
        return Refusal(candidate.name, values, outcome, reason, hypothesis.effect.decide)

    def _pruned(self, search: Search) -> Search:
        """The search without effects that make predictions of the judging half worse; the last added goes first.

        The last one was judged when it was added. The others are judged again, beside those that came after them.
        """
        for hypothesis in reversed(search.named[:-1]):
            fit = _without(search.fit, hypothesis, search.first)
            fit = fit_problem(fit.problem, fit.unknowns, fit.noise)
            predictive = self.predictive(fit)
            judged = self.judge(predictive.model)
            if judged.prediction_rmse_mm >= search.judged.prediction_rmse_mm:
                continue
            self.watch(f"{hypothesis.name} taken out again")
            reason = (
                f"{search.judged.prediction_rmse_mm:.1f} mm off on the judging half with it, "
                f"{judged.prediction_rmse_mm:.1f} mm without it"
            )
            values, decide = fitted_values(search.fit, hypothesis), hypothesis.effect.decide
            refusal = Refusal(hypothesis.name, values, Outcome.MISLEADING, reason, decide)
            kept = [h for h in search.named if h is not hypothesis and has_effect(fit.problem.model, h.name)]
            pruned = replace(
                search,
                fit=fit,
                predictive=predictive,
                judged=judged,
                named=tuple(kept),
                findings=tuple(f for f in search.findings if f.name in {h.name for h in kept}),
                refused=search.refused | {hypothesis.name: refusal},
            )
            return self._pruned(pruned)
        return search


def _without(fit: Fit, hypothesis: Hypothesis, first: Fit) -> Fit:
    """The fit without one of the effects that were added to the first one's model, at the same noise."""
    problem, name = fit.problem, hypothesis.name
    model = problem.model if has_effect(first.problem.model, name) else without_effect(problem.model, name)
    left = dict(model.named_parameters())
    free = {n: c for n, c in problem.free.items() if n in left and n not in hypothesis.columns}
    values = {n: fit.unknowns.values[n] for n in free}
    unknowns = replace(fit.unknowns, values=values)
    return fit_problem(replace(problem, model=model, free=free), unknowns, fit.noise, settle_noise=False)


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
