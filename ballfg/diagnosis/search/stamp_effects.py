"""Adds effects on stamps, visible in the tracks before any fit, and treats stamps that count kept frames.

A model takes such stamps for a slow clock, though each is off by up to a frame and more. Predictions get the stamps of
the file with that error as noise; the fit and checks of its flights have all frames.
"""

import copy
from dataclasses import replace

import numpy as np

from ballfg.diagnosis.fit.effects import with_effects, without_effect
from ballfg.diagnosis.fit.fit import first_guess, fit_model, fit_problem, reachable
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.holdout import EvaluationTrack, Holdout
from ballfg.diagnosis.fit.problem import Fit, Problem
from ballfg.diagnosis.fit.stamps import Stamps
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.result import Finding
from ballfg.diagnosis.search.ranking import fitted_values
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effects.measurement import CountedFrames, TimeScale
from ballfg.tracks import Dataset
from ballfg.tracks.noise import TrackNoise


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


def with_errors_of_counting(holdout: Holdout) -> Holdout:
    """The same halves; a dataset whose stamps count kept frames states how far its stamps are off, as a jitter."""
    counted, info = holdout.stamps.counted, holdout.dataset.info
    off = [np.std(track.seconds - counted[track.name]) for track in holdout.dataset if track.name in counted]
    if not off:
        return holdout
    stated = info.noise or TrackNoise()
    jitter = float(np.hypot(np.median(off), stated.stamp_jitter or 0.0))  # some tracks' frames are counted wrongly
    dataset = copy.copy(holdout.dataset)
    dataset.info = replace(info, noise=replace(stated, stamp_jitter=jitter))
    return replace(holdout, dataset=dataset)


def with_all_frames(holdout: Holdout, dataset: Dataset) -> Holdout:
    """The halves with the corrected stamps of the fit, for a model by `of_all_frames`. dataset: as it is written."""
    counted = holdout.stamps.counted
    if not counted:
        return holdout
    written = {track.name: track.seconds for track in dataset if track.name in counted}
    times = {track.name: (written[track.name], track.seconds) for track in holdout.tracks}

    def corrected(part: EvaluationTrack) -> EvaluationTrack:
        old, new = times[part.track.name]
        track = replace(part.track, times=np.interp(part.track.times, old, new))
        return EvaluationTrack(track, np.interp(part.bounces, old, new))

    halves = (tuple(map(corrected, half)) for half in (holdout.search_tracks, holdout.held_out_tracks))
    search, held_out = halves
    return replace(holdout, dataset=dataset, stamps=Stamps(), search_tracks=search, held_out_tracks=held_out)


def of_all_frames(model: AnalyticModel, stamps: Stamps) -> AnalyticModel:
    """A calibrated model for tracks with corrected stamps: without what it knows of counted stamps."""
    if not stamps.counted:
        return model
    bare = as_declared(model, stamps)
    bare.variations = model.variations
    return bare


def noise_of_all_frames(noise: TrackNoise | None, stamps: Stamps, dataset: Dataset) -> TrackNoise | None:
    """The found noise of the tracker for tracks with corrected stamps: of jitter what the dataset states."""
    if noise is None or not stamps.counted:
        return noise
    own = replace(noise, stamp_jitter=None if dataset.info.noise is None else dataset.info.noise.stamp_jitter)
    return own if own.memory is not None or own.stamp_jitter else None
