"""Treats stamps that count kept frames, in predictions and in checks of flights.

A model takes such stamps for a clock that is slow on average. Each of them is off by up to a frame and more, which
looks like hits, random motion or another spin. Predictions get the stamps of the file, so they have that error as
noise; the fit and checks of its flights have all frames.
"""

import copy
from dataclasses import replace

import numpy as np

from ballfg.diagnosis.fit.holdout import EvaluationTrack, Holdout
from ballfg.diagnosis.fit.stamps import Stamps
from ballfg.diagnosis.search.stamp_effects import as_declared
from ballfg.dynamics import AnalyticModel
from ballfg.tracks import Dataset
from ballfg.tracks.noise import TrackNoise


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
