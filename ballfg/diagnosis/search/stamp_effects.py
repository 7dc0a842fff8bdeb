"""Adds effects on stamps, visible in the tracks before any fit, to the model of the first fit."""

import numpy as np

from ballfg.diagnosis.fit.fit import first_guess, fit_model, fit_problem, reachable
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.fit.problem import Fit, Problem
from ballfg.diagnosis.fit.stamps import Stamps
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis, with_effects, without_effect
from ballfg.diagnosis.result import Finding
from ballfg.diagnosis.search.ranking import fitted_values
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effects.measurement import CountedFrames, TimeScale


def stamp_hypotheses(stamps: Stamps) -> tuple[Hypothesis, ...]:
    """The errors of stamps as effects.

    Missing frames and a clock act alike on average. If both were found, the number of frames is fixed as counted and
    the clock is fitted.
    """
    if "time_scale" not in stamps.found:
        return (Hypothesis(CountedFrames, {}, ("missing",)),) if stamps.found else ()
    clock = Hypothesis(TimeScale, {}, ("s",))
    return (Hypothesis(CountedFrames, {"missing": stamps.missing}), clock) if len(stamps.found) > 1 else (clock,)


def first_fit(model: AnalyticModel, holdout: Holdout) -> Fit:
    """The fit of a declared model to the search half, with the corrected stamps."""
    stamps, search, settings = holdout.stamps, holdout.search, holdout.settings
    named = stamp_hypotheses(stamps)
    if not named:
        return fit_model(model, search, settings, tracks=holdout.tracks)
    values = {"counted_frames": {"missing": stamps.missing}, "time_scale": {"s": stamps.scale}}
    stamped = with_effects(model, *(hypothesis.effect(**values[hypothesis.name]) for hypothesis in named))
    free = declared_free(model)
    for hypothesis in named:
        free |= hypothesis.free()
    problem = Problem(stamped, reachable(stamped, search), free)
    return fit_problem(problem, *first_guess(problem, settings.spin_label_noise, settings.spin_prior))


def as_declared(model: AnalyticModel, stamps: Stamps) -> AnalyticModel:
    """A calibrated model without the effects on stamps, with its noise and launcher."""
    if not stamps.found:
        return model
    bare = model
    for name in stamps.found:
        bare = without_effect(bare, name)
    bare.trained, bare.noise, bare.spins = model.trained, model.noise, model.spins
    return bare


def stamp_findings(first: Fit, stamps: Stamps, whole: Fit) -> tuple[Finding, ...]:
    """Effects on stamps with their evidence in the first fit, and their coefficients in the last one of a search."""
    tracks = len(np.unique(first.problem.stretches.track))
    findings = []
    for hypothesis in stamp_hypotheses(stamps):
        own, held_out = stamps.found[hypothesis.name]
        findings.append(
            Finding(
                name=hypothesis.name,
                kind=hypothesis.effect.kind,
                parameters=fitted_values(whole, hypothesis),
                p_value=own.p_value,
                delta_bic=float(np.log(tracks)) - 2.0 * tracks * own.gain,
                indistinguishable_from=(),
                held_out_gain=held_out.gain,
                held_out_p=held_out.p_value,
                sentence=hypothesis.effect.sentence,
                decide=hypothesis.effect.decide,
            )
        )
    return tuple(findings)
