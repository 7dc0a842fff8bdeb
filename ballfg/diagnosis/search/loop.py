"""The search adds, removes and exchanges effects as long as that makes the model more probable."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from ballfg.diagnosis.evidence.odds import Odds
from ballfg.diagnosis.fit.fit import fit_problem
from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.varying import Grouping
from ballfg.diagnosis.result import Candidate, Errors, Finding
from ballfg.diagnosis.search.found import Found
from ballfg.diagnosis.search.models import with_strengths_of
from ballfg.diagnosis.search.ranking import finding_of, ranking
from ballfg.diagnosis.search.stamp_effects import as_declared, first_fit, stamp_findings
from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.dynamics.effect import Effect

NAMED = 0.9  # Probability above which an effect is named


@dataclass(frozen=True)
class Search:
    """The result of a search."""

    first: Fit  # Of the declared model to the search half
    declared: AnalyticModel  # That model for predictions
    fit: Fit  # Of the model with the named effects to the search half
    predictive: AnalyticModel  # That model for predictions
    before: Errors  # Prediction errors of the declared model on the judging half
    judged: Errors  # Those of the model with the named effects
    whole: Fit  # The model with the named effects, fitted to the tracks of both halves
    findings: tuple[Finding, ...] = ()
    rounds: tuple[tuple[Candidate, ...], ...] = ()
    odds: Odds = field(default_factory=Odds)  # Probability of each effect that was weighed
    sigmas: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the coefficients of `whole`, beside what differs from track to track."""
    scatter: Mapping[str, float] = field(default_factory=dict)  # What coefficients differ by from track to track
    free: frozenset[str] = frozenset()  # Names of the fitted coefficients of the model with the named effects


@dataclass(frozen=True)
class SearchLoop:
    """The inputs of a search, the same in every round.

    `predictive` gives a fitted model the process noise that predicts the tracks of its fit; `judge` gives the errors of
    its predictions on the judging half; `watch` is called with lines of progress; refits share `jobs` processes.
    Effects `of_some` (None: all of the catalogue) may differ between tracks in `ways`, a function of the names of the
    tracks; None: by their labels and along the recording. Effects are named from the probability `name_at` on.
    """

    holdout: Holdout
    catalogue: Sequence[type[Effect]]
    predictive: Callable[[Fit], AnalyticModel]
    judge: Callable[[BallModel], Errors]
    watch: Callable[[str], None]
    jobs: int = 1
    of_some: Sequence[type[Effect]] | None = None
    ways: Callable[[Sequence[str]], list[Grouping]] | None = None
    name_at: float = NAMED

    def run(self, model: AnalyticModel, first: Fit | None = None) -> Search:
        """The most probable model, with the effects that are named.

        Args: model: as declared.  first: its fit, if made already.
        """
        self.watch(f"fitting the declared model to {len(self.holdout.search)} flights")
        first = first_fit(model, self.holdout) if first is None else first
        found = Found(self, first)
        found.search()
        sets = any(len(made.added) > 1 for made in found.rounds)
        if found.best.nameless and sets:  # one may have led into a poor minimum
            found.search_again()
        return self._told(found, first)

    def _told(self, found: Found, first: Fit) -> Search:
        """The search with the named effects only, its predictions and findings."""
        stamps, odds = self.holdout.stamps, found.odds
        final = found.named_at(self.name_at)
        plain = found.plain(final)
        whole = plain.alike
        if final.nameless and final.named:
            whole = with_strengths_of(final, whole)
        self.watch("predicting the other half")
        declared = self.predictive(first)
        judged = self.judge(declared)
        before = self.judge(as_declared(declared, stamps)) if stamps.found else judged
        fit, predictive = first, declared
        if final.named:
            problem = replace(whole.problem, stretches=first.problem.stretches)
            starts = whole.unknowns.starts[: len(first.problem.stretches)]
            fit = fit_problem(problem, replace(whole.unknowns, starts=starts), whole.noise)
            predictive = self.predictive(fit)
            judged = self.judge(predictive)
        rounds = {name: r for r in found.rounds for name in r.added}
        rests = [found.rest([h], final) for h in final.named]
        findings = []
        for h, rest in zip(final.named, rests, strict=True):
            own = rounds.get(h.name, found.rounds[-1])
            findings.append(finding_of(h, final, rest, odds, own.scored))
        return Search(
            first,
            declared,
            fit,
            predictive,
            before,
            judged,
            whole,
            (*stamp_findings(first, stamps, whole), *findings),
            tuple(ranking(r.scored, r.refits, r.added, odds) for r in found.rounds),
            odds,
            plain.sigmas,
            plain.scatter,
            frozenset((*fit.problem.free, *(final.fit.problem.free if final.named else ()))),
        )
