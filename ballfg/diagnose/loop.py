"""Closing the loop: fit, test, add what is lacking, and again, until nothing more helps; then say what remains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from ballfg.diagnose.calibrated import calibrated_model, values_of
from ballfg.diagnose.fit import Fit, Problem, fit, start_from
from ballfg.diagnose.halves import Halves, halves_of
from ballfg.diagnose.hypothesis import declared_free, hypotheses, with_effects
from ballfg.diagnose.judge import HeldOut, held_out, prediction_errors
from ballfg.diagnose.result import Candidate, Diagnosis, Errors, Finding, Standing, Value
from ballfg.diagnose.scene import scene_of
from ballfg.diagnose.trace import Refit, Scored, refit, score_all, shortlist
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.registry import EFFECTS
from ballfg.tracks import Dataset

MOST_EFFECTS = 4
"""Effects that are added before the search ends; further ones would be found in what earlier wrong ones left."""
CONFIRMED = 0.05
"""An effect stays only if its gain on the judging half would arise by chance less often than this."""
ALIKE = 6.0
"""BIC difference below which two effects cannot be told apart: odds of 20 to 1."""


@dataclass
class Search:
    """The state of the loop.

    Attributes:
        fit: of the model so far.  findings, rounds: as in `Diagnosis`.
    """

    fit: Fit
    findings: list[Finding] = field(default_factory=list)
    rounds: list[tuple[Candidate, ...]] = field(default_factory=list)


def search_effects(
    halves: Halves, model: AnalyticModel, catalogue: Sequence[type[Effect]], watch: Callable[[str], None]
) -> tuple[Fit, Search]:
    """Add effects until nothing helps.

    Args: halves: the data.  model: as declared.  catalogue: effects to look for.  watch: is told of progress.
    Returns: the fit of the declared model, and the search at its end.
    """
    declared = with_effects(model)
    problem = Problem(declared, halves.finding, declared_free(declared))
    watch(f"fitting the declared model to {len(halves.finding)} flights")
    first = fit(problem, *start_from(problem, halves.settings.spin_label_noise, halves.settings.spin_prior))
    search = Search(first)
    while len(search.findings) < MOST_EFFECTS and _round(search, halves, catalogue, watch):
        pass
    return first, search


def _round(
    search: Search, halves: Halves, catalogue: Sequence[type[Effect]], watch: Callable[[str], None]
) -> bool:
    """One round; whether an effect was added."""
    model = search.fit.problem.model
    assert isinstance(model, AnalyticModel)
    candidates = hypotheses(model, scene_of(search.fit), catalogue)
    watch(f"round {len(search.rounds) + 1}: testing {len(candidates)} hypotheses")
    scored = score_all(search.fit, candidates)
    refits = []
    for candidate in shortlist(scored):
        watch(f"round {len(search.rounds) + 1}: fitting with {candidate.hypothesis.name}")
        refits.append(refit(search.fit, candidate))
    refits.sort(key=lambda r: r.delta_bic)
    standing: dict[str, Standing] = {}
    winner, evidence = _confirmed(search.fit, refits, halves, standing)
    if winner is not None and evidence is not None:
        alike = tuple(
            r.scored.hypothesis.name
            for r in refits
            if r is not winner and r.delta_bic - winner.delta_bic < ALIKE and r.scored.hypothesis.name not in standing
        )
        standing |= dict.fromkeys(alike, Standing.ALIKE) | {winner.scored.hypothesis.name: Standing.ADDED}
        settled = fit(winner.fit.problem, winner.fit.unknowns, winner.fit.noise)
        search.findings.append(_finding(winner, settled, alike, evidence))
        search.fit = settled
    search.rounds.append(_ranking(scored, refits, standing))
    return winner is not None


def _confirmed(
    before: Fit, refits: Sequence[Refit], halves: Halves, standing: dict[str, Standing]
) -> tuple[Refit | None, HeldOut | None]:
    """The best refit that helps on the judging half too; `standing` tells of those that did not."""
    for candidate in refits:
        if candidate.delta_bic >= 0.0:
            break
        evidence = held_out(before, candidate.fit, halves.judging)
        if evidence.p_value < CONFIRMED:
            return candidate, evidence
        standing[candidate.scored.hypothesis.name] = Standing.NOT_HELPFUL
    return None, None


def _finding(winner: Refit, settled: Fit, alike: tuple[str, ...], evidence: HeldOut) -> Finding:
    hypothesis = winner.scored.hypothesis
    names = {hypothesis.parameter(c.name): c.name for c in hypothesis.effect.coefficients}
    fitted = values_of(settled, [n for n in names if n in settled.problem.free], {})
    return Finding(
        name=hypothesis.name,
        kind=hypothesis.effect.kind,
        sentence=hypothesis.effect.sentence,
        decide=hypothesis.effect.decide,
        parameters={names[n]: value for n, value in fitted.items()},
        p_value=winner.scored.p_value,
        delta_bic=winner.delta_bic,
        indistinguishable_from=alike,
        held_out_gain=evidence.gain,
        held_out_p=evidence.p_value,
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


