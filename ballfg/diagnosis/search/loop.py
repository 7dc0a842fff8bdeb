"""The search loop: fit, test, add the effect that is lacking, and repeat until nothing more helps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from ballfg.diagnosis.fit.fit import fit_problem
from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Errors, Outcome, Refusal
from ballfg.diagnosis.search.candidates import ALIKE, Refit, Scored, delta_bic, says_the_same
from ballfg.diagnosis.search.evaluation import got_worse, held_out_gain, on_all, on_others
from ballfg.diagnosis.search.hypothesis import Hypothesis
from ballfg.diagnosis.search.parsimony import halves_differ, insignificant
from ballfg.diagnosis.search.plausible import implausible, range_of
from ballfg.diagnosis.search.process_noise import PredictiveModel
from ballfg.diagnosis.search.ranking import NO_NAME, as_left, finding_of, fitted_values, ranking
from ballfg.diagnosis.search.stamp_effects import as_declared, first_fit, stamp_findings, stamp_hypotheses
from ballfg.diagnosis.search.state import Confirmed, Search, left_out, without_named
from ballfg.diagnosis.search.trial import try_further, try_hypotheses, try_varying
from ballfg.diagnosis.search.varying import Grouping, groupings
from ballfg.dynamics import AnalyticModel, BallModel, Effect
from ballfg.estimation.batch import do_all

MOST_EFFECTS = 4
"""Effects that are added before the search ends; further ones would be found in what earlier wrong ones left."""
CONFIRMED = 0.05
"""An effect stays only if its gain on the held-out half would arise by chance less often than this."""
WORSE = 1.1
"""Ratio of prediction errors beyond which an effect is not added, however much better whole tracks are fitted with it:
a wrong name for a lacking effect bends the motion to the samples, and predictions get worse."""
PLAUSIBLE = 10.0
"""Prior standard deviations from its usual value within which a coefficient is plausible. An effect that must be
stronger than that (air that moves at 20 m/s through a part of the room) stands for something else."""
POORER = 0.3
"""Share of an effect's gain that is there without the effect too, from which the fit before was in a poor minimum."""


Examined = Confirmed | tuple[Outcome, Fit]
"""A refit with all that confirms it, or why it is no name and its fit then."""


@dataclass(frozen=True)
class SearchLoop:
    """The inputs of a search, the same in every round.

    `predictive` gives a fitted model the process noise that predicts the tracks which it was fitted to; `judge` gives
    the errors of its predictions on the judging half; `watch` is told of progress, in lines; refits share `jobs`
    processes. Effects `of_some` (all of the catalogue where None) may differ between tracks in `ways`, which are asked
    for with the names of the tracks of the search half; None: by their labels and along the recording.
    """

    holdout: Holdout
    catalogue: Sequence[type[Effect]]
    predictive: Callable[[Fit], PredictiveModel]
    judge: Callable[[BallModel], Errors]
    watch: Callable[[str], None]
    plausible: float = PLAUSIBLE
    jobs: int = 1
    of_some: Sequence[type[Effect]] | None = None
    ways: Callable[[Sequence[str]], list[Grouping]] | None = None

    def run(self, model: AnalyticModel, first: Fit | None = None) -> Search:
        """Add effects to the declared model until none helps, then take out those without which it predicts better.

        Args: model: as declared.  first: its fit, where that was made already.
        """
        self.watch(f"fitting the declared model to {len(self.holdout.search)} flights")
        stamps = self.holdout.stamps
        first = first_fit(model, self.holdout) if first is None else first
        declared = self.predictive(first)
        judged = self.judge(declared.model)
        before = self.judge(as_declared(declared.model, stamps)) if stamps.found else judged
        named, findings = stamp_hypotheses(stamps), stamp_findings(first, stamps)
        search, helped = Search(first, declared, first, declared, before, judged, first, named, findings), True
        while helped and len(search.rounds) < MOST_EFFECTS:
            search, helped = self._round(search)
        search = self._pruned(search)
        refused = {n: r for n, r in search.refused.items() if n not in {f.name for f in search.findings}}
        findings = as_left(search.findings, search.named, search.whole, first)
        return replace(search, findings=findings, refused=refused)

    def _round(self, search: Search) -> tuple[Search, bool]:
        """The search after one more round, and whether the round added an effect."""
        number = len(search.rounds) + 1
        on_before = on_others(search.fit, self.holdout.held_out)
        scored, refits = self._tried(search, on_before, number)
        if refits and (better := self._better_minimum(search, refits[0])) is not None:
            search, on_before = better, on_others(better.fit, self.holdout.held_out)
            scored, refits = self._tried(search, on_before, number)
        outcomes: dict[str, Outcome] = {}
        tell = partial(self._tell, number)
        misleading: list[Refit] = []
        winner, refused = self._confirmed(search, on_before, refits, outcomes, misleading)
        while winner is None and (fitted := try_further(search.fit, scored, refits, tell, self.jobs)):
            winner, further = self._confirmed(search, on_before, fitted, outcomes, misleading)
            refits, refused = [*refits, *fitted], refused | further
        if winner is None:  # a pattern that one effect explains for all tracks must not get a name for each group
            ways = self.ways or partial(groupings, self.holdout.tracks)
            some = self.of_some or self.catalogue
            more, fitted = try_varying(search.fit, some, self.holdout.held_out, ways, tell, self.jobs)
            winner, further = self._confirmed(search, on_before, fitted, outcomes, misleading)
            scored, refits, refused = [*scored, *more], [*refits, *fitted], refused | further
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
            findings=(*kept, finding_of(winner.refit, winner.whole, winner.evidence, alike)),
            rounds=(*search.rounds, ranking(scored, refits, outcomes)),
            refused=search.refused | refused,
        )
        return after, True

    def _tried(self, search: Search, on_before: Fit, number: int) -> tuple[list[Scored], list[Refit]]:
        whole = on_all(search.fit, on_before)
        return try_hypotheses(search.fit, whole, self.catalogue, partial(self._tell, number), self.jobs)

    def _on_all(self, fit: Fit) -> Fit:
        """The fit to the tracks of both halves, from one to the search half: significance is theirs."""
        return on_all(fit, on_others(fit, self.holdout.held_out))

    def _tell(self, number: int, line: str) -> None:
        self.watch(f"round {number}: {line}")

    def _better_minimum(self, search: Search, best: Refit) -> Search | None:
        """The search from a better minimum of the same model, to which a refit has led; None if there is none.

        Spins without labels leave several minima. An effect that leads out of a poor one has not explained anything:
        without it the fit stays as good.
        """
        if best.delta_bic >= 0.0:
            return None
        fit = without_named(best.fit, best.scored.hypothesis, search.first)
        if not search.fit.cost - fit.cost > POORER * (search.fit.cost - best.fit.cost):
            return None
        self.watch("a better minimum of the fit was found")
        settled = fit_problem(fit.problem, fit.unknowns, fit.noise)
        predictive = self.predictive(settled)
        if predictive.errors.prediction_rmse_mm > WORSE * search.predictive.errors.prediction_rmse_mm:
            return None
        judged = self.judge(predictive.model)
        moved = replace(search, fit=settled, predictive=predictive, judged=judged)
        if search.named:
            return moved
        return replace(moved, first=settled, declared=predictive, before=judged)

    def _confirmed(
        self,
        search: Search,
        on_before: Fit,
        refits: Sequence[Refit],
        outcomes: dict[str, Outcome],
        misleading: list[Refit],
    ) -> tuple[Confirmed | None, dict[str, Refusal]]:
        """The best refit that deserves a name, and better ones that do not; fills in their outcomes.

        What one effect explains gets no lesser name only because the better one predicted a few balls worse; such
        better ones are added to `misleading`.
        """
        refused: dict[str, Refusal] = {}
        waiting, examined = [r for r in refits if r.delta_bic < 0.0], dict[int, Examined]()
        for place, candidate in enumerate(waiting):
            if any(says_the_same(candidate, better) for better in misleading):
                examined[id(candidate)] = Outcome.SAME_PATTERN, candidate.fit
            elif id(candidate) not in examined:
                examined |= self._examined_together(search, waiting[place:], on_before, misleading)
            found = examined[id(candidate)]
            if isinstance(found, Confirmed):
                return found, refused
            outcomes[candidate.name], settled = found
            misleading += [candidate] if outcomes[candidate.name] is Outcome.MISLEADING else []
            if outcomes[candidate.name] in NO_NAME:
                refused[candidate.name] = self._refusal(candidate.scored.hypothesis, settled, outcomes[candidate.name])
        return None, refused

    def _examined_together(
        self, search: Search, waiting: Sequence[Refit], on_before: Fit, misleading: Sequence[Refit]
    ) -> dict[int, Examined]:
        """The next refits examined, by their id, one a process: where the first is refused, the second is wanted."""
        others = [r for r in waiting if not any(says_the_same(r, better) for better in misleading)][: self.jobs]
        silent = replace(self, watch=_untold) if len(others) > 1 else self  # what is told of progress stays here
        tasks = [partial(silent._examined, search, candidate, on_before) for candidate in others]
        return dict(zip(map(id, others), do_all(tasks, self.jobs), strict=True))

    def _examined(self, search: Search, candidate: Refit, on_before: Fit) -> Examined:
        """A refit with all that confirms it, or why it is no name and its fit then; cheap questions come first."""
        hypothesis = candidate.scored.hypothesis
        evidence = held_out_gain(search.fit, candidate.fit, self.holdout.held_out, on_before)
        if evidence.p_value >= CONFIRMED:
            return Outcome.NOT_HELPFUL, candidate.fit
        settled = fit_problem(candidate.fit.problem, candidate.fit.unknowns, candidate.fit.noise)
        whole = self._on_all(settled)
        if self._implausible(hypothesis, whole):
            return Outcome.IMPLAUSIBLE, whole
        idle = insignificant(whole, [*search.named, hypothesis], search.first)
        if hypothesis in idle:
            return Outcome.INSIGNIFICANT, whole
        idle += [h for h in search.named if h not in idle and self._pushed(h, search.fit, whole)]
        kept = tuple(h for h in search.named if h not in idle)
        if idle:
            alone = candidate.fit
            for other in idle:
                alone = without_named(alone, other, search.first)
            if delta_bic(search.fit, alone) >= 0.0:
                return Outcome.SAME_PATTERN, whole
            settled = fit_problem(alone.problem, alone.unknowns, alone.noise)
            whole = self._on_all(settled)
        if not _same_change(search, hypothesis) and halves_differ(settled, hypothesis, self.holdout.held_out):
            return Outcome.CONTRADICTORY, whole
        predictive = self.predictive(settled)
        if predictive.errors.prediction_rmse_mm > WORSE * search.predictive.errors.prediction_rmse_mm:
            return Outcome.MISLEADING, whole
        judged = self.judge(predictive.model)
        if got_worse(judged, search.judged):
            return Outcome.MISLEADING, whole
        return Confirmed(candidate, evidence, kept, settled, whole, predictive, judged)

    def _implausible(self, hypothesis: Hypothesis, fit: Fit) -> str:
        """Why the fitted strengths of an effect are not plausible; empty if they are."""
        values = fitted_values(fit, hypothesis)
        radius = fit.problem.model.radius
        known = [implausible(hypothesis.known_as(n), values[n], radius) for n in hypothesis.strengths]
        if any(known):
            return next(text for text in known if text)
        ranged = all(range_of(hypothesis.known_as(n), radius) for n in hypothesis.strengths)
        if not ranged and hypothesis.strain(fit.unknowns.values) > self.plausible:
            return f"more than {self.plausible:g} times its typical distance from the usual value"
        return ""

    def _pushed(self, hypothesis: Hypothesis, before: Fit, after: Fit) -> bool:
        """Whether the strengths of an effect are plausible, and would not be beside a further effect."""
        return bool(self._implausible(hypothesis, after)) and not self._implausible(hypothesis, before)

    def _refusal(self, hypothesis: Hypothesis, fit: Fit, outcome: Outcome) -> Refusal:
        """An effect that fits better and is no name; fit: with it."""
        reason = self._implausible(hypothesis, fit) if outcome is Outcome.IMPLAUSIBLE else ""
        return Refusal(hypothesis.name, fitted_values(fit, hypothesis), outcome, reason, hypothesis.decide)

    def _pruned(self, search: Search, *, examined: int = 1) -> Search:
        """The search without effects that are no names beside those that came after them; the last added goes first.

        Effects are asked again whether they are plausible, differ from zero, and make predictions of the judging half
        better; not so the last ones that were `examined` beside all others when they were added.
        """
        whole = self._on_all(search.fit)
        idle = insignificant(whole, search.named, search.first)
        for hypothesis in reversed(search.named[: len(search.named) - examined]):
            if hypothesis.name in self.holdout.stamps.found:
                continue
            fit = without_named(search.fit, hypothesis, search.first)
            fit = fit_problem(fit.problem, fit.unknowns, fit.noise)
            predictive = self.predictive(fit)
            judged = self.judge(predictive.model)
            refusal = None
            if self._implausible(hypothesis, whole):
                refusal = self._refusal(hypothesis, whole, Outcome.IMPLAUSIBLE)
            elif hypothesis in idle:
                refusal = self._refusal(hypothesis, whole, Outcome.INSIGNIFICANT)
            elif got_worse(search.judged, judged):
                reason = (
                    f"{search.judged.prediction_rmse_mm:.1f} mm off on the judging half with it, "
                    f"{judged.prediction_rmse_mm:.1f} mm without it"
                )
                refusal = replace(self._refusal(hypothesis, whole, Outcome.MISLEADING), reason=reason)
            if refusal is not None:
                self.watch(f"{hypothesis.name} taken out again")
                return self._pruned(left_out(search, hypothesis, fit, predictive, judged, refusal), examined=0)
        return replace(search, whole=whole)


def _untold(_line: str) -> None:
    """Nobody is told of progress."""


def _same_change(search: Search, hypothesis: Hypothesis) -> bool:
    """Whether an effect changes at the track at which another one was found to change.

    A new table changes several coefficients at once. Until all of them are in the model each bends to make up for the
    others, in either half differently.
    """
    found = {deviation.level for deviation in search.fit.problem.deviations.values() if deviation.first}
    return any(deviation.level in found for deviation in hypothesis.deviations().values())
