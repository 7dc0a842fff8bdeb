"""The whole diagnosis of a dataset: search, judge, look at what is left, and put the answer into one sentence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ballfg.diagnosis.fit.holdout import Halves, halves_of
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.process_noise import Predicting, with_process_noise
from ballfg.diagnosis.remains.fallback import fallback
from ballfg.diagnosis.remains.generic import ALARM, generic_tests
from ballfg.diagnosis.remains.residuals import residuals_of
from ballfg.diagnosis.report.wording import sentence
from ballfg.diagnosis.result import Diagnosis, Errors, Fallback, GenericTest, Unexplained, Value, Verdict
from ballfg.diagnosis.search.calibrated import calibrated_model, values_of
from ballfg.diagnosis.search.evaluation import prediction_errors
from ballfg.diagnosis.search.loop import Search, search_effects
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.effects.registry import EFFECTS
from ballfg.dynamics.model import BallModel
from ballfg.estimation.configure import dataset_settings
from ballfg.tracks import Dataset

MOSTLY = 0.1
"""Of the pattern that was there at the start: where effects leave less than this share, they are the explanation."""

DESCRIBABLE = ("flight", "contact", "measurement")
"""Tests whose patterns a model could follow that is the same for every track."""


def diagnose(
    dataset: Dataset,
    model: BallModel,
    *,
    jobs: int = 1,
    watch: Callable[[str], None] | None = None,
    catalogue: Sequence[type[Effect]] | None = None,
) -> Diagnosis:
    """What a model lacks, how sure that is, what else it could be, and how much better predictions get.

    Args:
        dataset: tracks; every second one is searched, the others judge.
        model: the analytic model that one believes in.
        jobs: processes for what is done track by track.
        watch: told of each stage in one line.
        catalogue: effects to look for; by default all that are registered.
    Raises:
        TypeError: if the model is a learned one.
        ValueError: if there are too few tracks, or none with a flight that is long enough.
    """
    if not isinstance(model, AnalyticModel):
        raise TypeError(
            f"model must be an AnalyticModel, to which effects can be added; got {type(model).__name__}. "
            "Diagnose its analytic part."
        )
    tell = watch or _silent
    halves = halves_of(dataset, model, jobs, tell)
    predict = partial(_predicting, halves=halves, jobs=jobs)
    search = search_effects(halves, model, tuple(catalogue or EFFECTS.values()), predict, tell)
    tell("predicting the judging half")
    judge = partial(_errors, halves, jobs)
    before = judge(search.declared.model)
    named = judge(search.predicting.model) if search.findings else before
    tell("looking at what is left")
    tests = generic_tests(search.fit, search.first)
    verdict = _verdict(search, tests)
    helped = None
    if verdict is Verdict.UNEXPLAINED and any(t.name in DESCRIBABLE for t in _alarms(tests)):
        tell("describing what is left without a name")
        tracks = [part.track for part in halves.found_on]
        helped = fallback(search.fit, halves.launcher.embedding, dataset, tracks, named, judge)
    unexplained = _unexplained(verdict, tests, helped)
    residuals = residuals_of(search.first)
    return Diagnosis(
        dataset=dataset.info.name,
        verdict=verdict,
        sentence=sentence(verdict, search.findings, unexplained),
        findings=tuple(search.findings),
        rounds=tuple(search.rounds),
        before=before,
        after=named if helped is None else helped.after,
        tracks_found_on=len(np.unique(halves.finding.track)),
        tracks_judged_on=len(before.by_track),
        calibrated=_calibrated(search.fit, model),
        noise=_noise(search.fit, halves),
        unexplained=unexplained,
        model=search.predicting.model if helped is None else helped.model,
        residuals_before=residuals,
        residuals_after=residuals if search.fit is search.first else residuals_of(search.fit),
        excluded=halves.excluded,
    )


def _silent(line: str) -> None:
    """Watches nothing."""


def _predicting(fit: Fit, halves: Halves, jobs: int) -> Predicting:
    """A fitted model with the process noise that predicts the finding half best."""
    model = calibrated_model(fit, halves.launcher.embedding)
    return with_process_noise(model, halves.found_on, halves.dataset, jobs)


def _errors(halves: Halves, jobs: int, model: BallModel) -> Errors:
    settings = dataset_settings(halves.dataset, model)
    return prediction_errors(model, halves.judged, halves.surfaces, settings, jobs)


def _alarms(tests: Sequence[GenericTest]) -> list[GenericTest]:
    return [test for test in tests if test.p_value < ALARM]


def _share(tests: Sequence[GenericTest]) -> float:
    return max((test.share for test in _alarms(tests)), default=0.0)


def _verdict(search: Search, tests: Sequence[GenericTest]) -> Verdict:
    """Effects explain what was there if they leave no pattern, or next to nothing of it."""
    if not search.findings:
        return Verdict.UNEXPLAINED if _alarms(tests) else Verdict.NOTHING
    return Verdict.FOUND if _share(tests) < MOSTLY else Verdict.UNEXPLAINED


def _unexplained(verdict: Verdict, tests: tuple[GenericTest, ...], helped: Fallback | None) -> Unexplained:
    alarms = sorted(_alarms(tests), key=lambda test: test.name == "time")  # a place says more than a memory
    return Unexplained(alarms[0].where if alarms else "", _share(tests), tests, helped)


def _calibrated(fit: Fit, declared: AnalyticModel) -> dict[str, Value]:
    values = {name: float(value.detach()) for name, value in declared.named_parameters()}
    return values_of(fit, [name for name in fit.problem.free if name in values], values)


def _noise(fit: Fit, halves: Halves) -> dict[str, Value]:
    """Position noise along each axis: estimated, and as the dataset states it or its scatter shows."""
    stated, used = halves.settings.position_noise, fit.problem.stretches.used.numpy()
    count = float(used.sum())
    return {
        axis: Value(float(np.median(fit.sigmas[..., a][used])), float(stated[a] / np.sqrt(2.0 * count)), "m", stated[a])
        for a, axis in enumerate("xyz")
    }
