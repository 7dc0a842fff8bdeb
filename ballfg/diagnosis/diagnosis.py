"""Diagnoses a dataset: it searches effects, evaluates them, tests the rest, and states the answer in one sentence."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ballfg.checks import check_range
from ballfg.diagnosis.error_budget import budget_of
from ballfg.diagnosis.fit.fit import noise_by_axis, values_of
from ballfg.diagnosis.fit.free import OWN_AIR, spread
from ballfg.diagnosis.fit.holdout import Holdout, analytic, hold_out
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.stamps import Stamps
from ballfg.diagnosis.generic_test import ALARM, APART, PREDICTED, GenericTest, LabelCheck
from ballfg.diagnosis.report.wording import sentence, sized
from ballfg.diagnosis.residual_tests.generic import generic_tests, predicted_test
from ballfg.diagnosis.residual_tests.label_check import check_labels, label_test
from ballfg.diagnosis.residual_tests.residuals import residuals_of
from ballfg.diagnosis.residual_tests.sparse import fallback
from ballfg.diagnosis.residual_tests.tracker_errors import look_at_tracker
from ballfg.diagnosis.result import Diagnosis, Errors, Fallback, Unexplained, Value, Verdict
from ballfg.diagnosis.search.evaluation import (
    calibrated_model,
    errors_of,
    has_population,
    next_shot_model,
    noise_about,
    predictive_model,
    unpopulated_model,
)
from ballfg.diagnosis.search.loop import NAMED, Search, SearchLoop
from ballfg.diagnosis.search.predicting import best_predicting, told_shifts
from ballfg.diagnosis.search.ranking import at_bound, implausible
from ballfg.diagnosis.search.stamp_effects import (
    as_declared,
    noise_of_all_frames,
    of_all_frames,
    with_all_frames,
    with_errors_of_counting,
)
from ballfg.dynamics import EFFECTS, AnalyticModel, BallModel
from ballfg.dynamics.domain import Domain
from ballfg.dynamics.effect import Effect
from ballfg.tracks import Dataset
from ballfg.tracks.noise import TrackNoise

MOSTLY = 0.1  # Share of the first pattern below which the found effects count as its explanation
DESCRIBABLE = ("flight", "contact", "measurement")  # Tests of patterns that one model for all tracks can describe


def diagnose(
    dataset: Dataset,
    model: BallModel,
    *,
    jobs: int = 1,
    watch: Callable[[str], None] | None = None,
    catalogue: Sequence[type[Effect]] | None = None,
    name_at: float = NAMED,
) -> Diagnosis:
    """Find the effects that a model lacks, their evidence and alternatives, and the gain in prediction.

    Args:
        dataset: tracks. Every second one is searched; the others are held out to evaluate the effects found.
        model: the analytic model to compare the tracks with.
        jobs: number of processes.
        watch: called with a line for each stage.
        catalogue: candidate effects; by default all registered ones.
        name_at: probability, 0 to 1, from which on an effect is named.
    Returns: the verdict, the findings with their evidence, errors before and after, and the corrected model.
    Raises:
        TypeError: if the model is a learned one.
        ValueError: if there are too few tracks, or none with a flight that is long enough.
    """
    check_range("name_at", name_at, 0.0, 1.0)
    model = analytic(model)
    tell = watch or (lambda line: None)
    holdout = with_errors_of_counting(hold_out(dataset, model, jobs, tell))
    evaluate = partial(errors_of, holdout=holdout, tracks=holdout.held_out_tracks, jobs=jobs)
    effects = tuple(catalogue or EFFECTS.values())
    loop = SearchLoop(
        holdout, effects, partial(predictive_model, holdout, jobs), evaluate, tell, jobs=jobs, name_at=name_at
    )
    search = loop.run(model)
    corrected, tracker, search = _with_own_noise(search, holdout, evaluate, tell, jobs)
    tell("looking at what is left")
    of_fit = noise_of_all_frames(tracker, holdout.stamps, dataset)
    labels, of_labels = _labels(search, model, with_all_frames(holdout, dataset), holdout.stamps, of_fit, jobs)
    searched = len(np.unique(holdout.search.track))
    of_fits = (*generic_tests(search.fit, search.first, of_fit), *of_labels)
    tests = in_order(*of_fits, predicted_test(search.before, search.judged, searched))
    probable = corrected
    if verdict_of(search, tests) is Verdict.UNEXPLAINED:
        tell("fitting coefficients to predictions")
        corrected, search = _predicting(search, corrected, tracker, holdout, evaluate, jobs)
        tests = in_order(*of_fits, predicted_test(search.before, search.judged, searched))
    helped = None
    if verdict_of(search, tests) is Verdict.UNEXPLAINED and any(t.name in DESCRIBABLE for t in alarms(tests)):
        tell("describing what is left without a name")
        helped = fallback(search.fit, corrected, search.judged, holdout, jobs)
    whole = corrected  # as judged, where it is fitted to predictions; else fitted to both halves
    if corrected is probable:
        whole = next_shot_model(search.whole, holdout.launcher.embedding, corrected)
        whole.noise = corrected.noise
    whole.domain = Domain.of(dataset, [dataset.info.ball.radius]) if search.findings else model.domain
    found = told(search, model, dataset.info.name, whole, searched, tests, labels, helped)
    budget = budget_of(corrected, holdout, found.before.prediction_rmse_mm, found.after.prediction_rmse_mm, jobs)
    unpopulated = search.before
    if has_population(search.declared):
        unpopulated = evaluate(as_declared(unpopulated_model(search.declared, holdout, jobs), holdout.stamps))
    shifts = told_shifts(corrected, probable, search.free)
    return replace(
        found,
        remarks=(*found.remarks, *([shifts] if shifts else [])),
        unpopulated=unpopulated,
        noise=_noise(search.fit, holdout),
        excluded=holdout.excluded,
        floor_mm=float("nan") if budget is None else budget.exact,
        budget=budget,
    )


def told(
    search: Search,
    declared: AnalyticModel,
    dataset: str,
    corrected: BallModel,
    searched: int,
    tests: tuple[GenericTest, ...],
    labels: LabelCheck | None,
    helped: Fallback | None = None,
) -> Diagnosis:
    """The result of a search, without what is of one dataset alone: noise, excluded tracks, budget.

    Args:
        declared, corrected: the models before and after, the latter without the fallback.
        dataset: its name.  searched: number of tracks of the search half.
        tests, labels: of what is left, and verdicts on spin labels.  helped: a description without a name.
    """
    verdict, unexplained = verdict_of(search, tests), what_is_left(tests, helped)
    given = {name: float(value.detach()) for name, value in declared.named_parameters()}
    calibrated = {
        name: replace(value, sigma=search.sigmas.get(name, value.sigma))
        for name, value in values_of(search.whole, [n for n in search.whole.problem.free if n in given], given).items()
    }
    residuals = residuals_of(search.first)
    return Diagnosis(
        dataset=dataset,
        verdict=verdict,
        sentence=sentence(verdict, search.findings, unexplained),
        findings=search.findings,
        rounds=search.rounds,
        before=search.before,
        after=search.judged if helped is None else helped.after,
        tracks_found_on=searched,
        tracks_judged_on=len(search.before.by_track),
        calibrated=calibrated,
        noise={},
        unexplained=unexplained,
        model=corrected if helped is None else helped.model,
        residuals_before=residuals,
        residuals_after=residuals if search.fit is search.first else residuals_of(search.fit),
        remarks=(*strange(search.whole, calibrated, declared.radius), *differing(search)),
        labels=labels,
        probabilities=search.odds.effects(),
        nothing_lacking=search.odds.nothing,
        nameless=search.odds.nameless,
    )


def _labels(
    search: Search, model: AnalyticModel, holdout: Holdout, stamps: Stamps, tracker: TrackNoise | None, jobs: int
) -> tuple[LabelCheck | None, tuple[GenericTest, ...]]:
    """The verdicts on the spin labels, and their test; None without labels. holdout: with all frames."""

    def checked(fit: Fit) -> LabelCheck | None:
        corrected = of_all_frames(calibrated_model(fit, holdout.launcher.embedding), stamps)
        return check_labels(corrected, model, holdout, tracker, jobs=jobs)

    now = checked(search.whole)
    if now is None:
        return None, ()
    before = checked(search.first) if now.contradicted and search.findings else None
    return now, (label_test(now, before),)


def _with_own_noise(
    search: Search, holdout: Holdout, evaluate: Callable[[BallModel], Errors], tell: Callable[[str], None], jobs: int
) -> tuple[AnalyticModel, TrackNoise | None, Search]:
    """The corrected model with its own noise, the tracker's if it is not white, and the search with that tracker."""
    declared, corrected = search.declared, search.predictive
    tell("looking at the tracker")
    tracker = look_at_tracker(corrected, holdout, jobs)
    if not tracker.findings:
        return corrected, tracker.noise, search
    tell(f"{' and '.join(finding.name for finding in tracker.findings)} found")
    for model in dict.fromkeys((declared, corrected)):
        model.noise = noise_about(model, holdout.search_tracks, holdout.dataset, tracker.noise, jobs=jobs)
    search = replace(
        search,
        before=evaluate(as_declared(declared, holdout.stamps)),
        judged=evaluate(corrected),
        findings=(*search.findings, *tracker.findings),
    )
    return corrected, tracker.noise, search


def _predicting(
    search: Search,
    corrected: AnalyticModel,
    tracker: TrackNoise | None,
    holdout: Holdout,
    evaluate: Callable[[BallModel], Errors],
    jobs: int,
) -> tuple[AnalyticModel, Search]:
    """The corrected model and the declared one with the coefficients that predict best, and the search with both."""
    declared = best_predicting(search.declared, search.first.problem.free, holdout, tracker, jobs)
    best = declared if corrected is search.declared else best_predicting(corrected, search.free, holdout, tracker, jobs)
    if declared is not search.declared:
        search = replace(search, declared=declared, before=evaluate(as_declared(declared, holdout.stamps)))
    return best, search if best is corrected else replace(search, predictive=best, judged=evaluate(best))


def strange(fit: Fit, calibrated: Mapping[str, Value], radius: float) -> list[str]:
    """Sentences on implausible values of declared coefficients, and on all fitted ones that end at a bound."""
    words = "Something that the model does not describe has moved it: a clock, lengths or spin labels, say"
    texts = []
    for full, coefficient in fit.problem.free.items():
        name = full.partition(".")[2]
        value = calibrated.get(full, Value(fit.unknowns.values[full], 0.0, coefficient.unit))
        known = implausible(name, value, radius) if full in calibrated else ""
        texts += [text for text in (known, at_bound(name, value, coefficient)) if text]
    return [f"The fitted {text}. {words}." for text in texts]


TOLD = 0.2  # Share of a coefficient's prior deviation from which on its scatter between tracks is told


def differing(search: Search) -> list[str]:
    """A sentence on coefficients and a wind that differ from track to track; none where they hardly do."""
    listed, values = search.whole.problem.in_own_air.declared_coefficients(), search.whole.unknowns.values
    told = []
    for full, size in search.scatter.items():
        coefficient = listed[full]
        if size < TOLD * spread(coefficient) or full in OWN_AIR[1:]:
            continue
        name = "the wind" if full in OWN_AIR else full.partition(".")[2]
        share = f" ({100.0 * size / abs(values[full]):.2g} %)" if values.get(full) else ""
        told.append(f"{name} by {sized(size, coefficient.unit)}{share}")
    return [f"From track to track differ: {', '.join(told)}."] if told else []


def in_order(*tests: GenericTest) -> tuple[GenericTest, ...]:
    """Tests with the least probable first."""
    return tuple(sorted(tests, key=lambda test: test.p_value))


def alarms(tests: Sequence[GenericTest]) -> list[GenericTest]:
    """Tests that find a pattern."""
    return [test for test in tests if test.p_value < ALARM]


def share_left(tests: Sequence[GenericTest]) -> float:
    """The largest share of a first pattern that remains, 0 to 1."""
    return max((test.share for test in alarms(tests)), default=0.0)


def what_is_left(tests: tuple[GenericTest, ...], helped: Fallback | None = None) -> Unexplained:
    """The remaining pattern, in words, with all tests; helped: its description without a name."""
    vague = ("time", APART, PREDICTED)  # a place says more
    left = sorted(alarms(tests), key=lambda test: test.name in vague)
    return Unexplained(left[0].where if left else "", share_left(tests), tests, helped)


def verdict_of(search: Search, tests: Sequence[GenericTest]) -> Verdict:
    """Effects explain the first pattern if they leave none, or almost none, of it."""
    if not search.findings:
        return Verdict.UNEXPLAINED if alarms(tests) else Verdict.NOTHING
    return Verdict.FOUND if share_left(tests) < MOSTLY else Verdict.UNEXPLAINED


def _noise(fit: Fit, holdout: Holdout) -> dict[str, Value]:
    """Position noise along each axis, as estimated, and as stated by the dataset or derived from its scatter."""
    stated, count = holdout.settings.position_noise, float(fit.problem.stretches.used.sum())
    return {
        axis: Value(shown, shown / np.sqrt(2.0 * count), "m", stated[a])
        for a, (axis, shown) in enumerate(zip("xyz", noise_by_axis(fit).tolist(), strict=True))
    }
