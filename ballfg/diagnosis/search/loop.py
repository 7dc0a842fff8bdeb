"""The search loop fits, tests, adds the missing effect, and repeats until no effect helps."""

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
from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.dynamics.effect import Effect
from ballfg.estimation.batch import do_all

MOST_EFFECTS = 4
"""Largest number of added effects; further ones would fit the errors of earlier wrong ones."""
CONFIRMED = 0.05
"""Significance level of an effect's gain on the held-out half."""
WORSE = 1.1
"""Ratio of prediction errors above which an effect is not added, even if whole tracks are fitted better: a wrong name
for a missing effect bends the motion to the samples, and predictions get worse."""
PLAUSIBLE = 10.0
"""Prior standard deviations from its usual value within which a coefficient is plausible. A stronger effect (air that
moves at 20 m/s through a part of the room) stands for something else."""
POORER = 0.3
"""Share of an effect's gain that remains without the effect, above which the previous fit was in a poor minimum."""


Examined = Confirmed | tuple[Outcome, Fit]
"""A refit with its confirmation, or the reason for its refusal and its fit."""


@dataclass(frozen=True)
class SearchLoop:
    """The inputs of a search, the same in every round.

    `predictive` gives a fitted model the process noise that predicts the tracks of its fit; `judge` gives the errors of
    its predictions on the judging half; `watch` is called with lines of progress; refits share `jobs` processes.
    Effects `of_some` (None: all of the catalogue) may differ between tracks in `ways`, a function of the names of the
    search half's tracks; None: by their labels and along the recording.
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
        """Adds effects to the declared model until none helps, then removes those without which predictions are better.

        Args: model: as declared.  first: its fit, if made already.
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
        """The search after one more round, and True if the round added an effect."""
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
        """The fit to the tracks of both halves, from one to the search half, for significance tests."""
        return on_all(fit, on_others(fit, self.holdout.held_out))

    def _tell(self, number: int, line: str) -> None:
        self.watch(f"round {number}: {line}")

    def _better_minimum(self, search: Search, best: Refit) -> Search | None:
        """The search from a better minimum of the same model, found by a refit; None without one.

        Spins without labels cause several minima. An effect that leads out of a poor one has not explained anything:
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

        If a better effect was refused only because it predicted a few balls worse, its pattern gets no lesser name;
        such effects are added to `misleading`.
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
        """The next refits examined in parallel, by their id: if the first is refused, the second is needed."""
        others = [r for r in waiting if not any(says_the_same(r, better) for better in misleading)][: self.jobs]
        silent = replace(self, watch=_untold) if len(others) > 1 else self  # progress is reported in this process
        tasks = [partial(silent._examined, search, candidate, on_before) for candidate in others]
        return dict(zip(map(id, others), do_all(tasks, self.jobs), strict=True))

    def _examined(self, search: Search, candidate: Refit, on_before: Fit) -> Examined:
        """A refit with its confirmation, or the reason for its refusal and its fit; cheap tests come first."""
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
        """The reason why the fitted strengths of an effect are implausible; empty if they are plausible."""
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
        """True if an effect's strengths are plausible, but would not be beside a further effect."""
        return bool(self._implausible(hypothesis, after)) and not self._implausible(hypothesis, before)

    def _refusal(self, hypothesis: Hypothesis, fit: Fit, outcome: Outcome) -> Refusal:
        """The refusal of an effect that fits better; fit: with it."""
        reason = self._implausible(hypothesis, fit) if outcome is Outcome.IMPLAUSIBLE else ""
        return Refusal(hypothesis.name, fitted_values(fit, hypothesis), outcome, reason, hypothesis.decide)

    def _pruned(self, search: Search, *, examined: int = 1) -> Search:
        """The search without effects that later ones made superfluous; the last added is tested first.

        Each effect must still be plausible, differ from zero, and improve predictions of the judging half; the last
        ones that were `examined` beside all others are not tested again.
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
    """Reports no progress."""


def _same_change(search: Search, hypothesis: Hypothesis) -> bool:
    """True if an effect changes at the same track as an earlier found one.

    A new table changes several coefficients at once. Until the model has all of them, each compensates for the others,
    differently in either half.
    """
    found = {deviation.level for deviation in search.fit.problem.deviations.values() if deviation.first}
    return any(deviation.level in found for deviation in hypothesis.deviations().values())
