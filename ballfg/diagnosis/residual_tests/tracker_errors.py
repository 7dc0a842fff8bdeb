"""Reports memory of the tracker and jitter of the stamps as findings, after the search for effects.

A memory would absorb any effect that bends flights slowly, so effects are searched first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballfg.diagnosis.fit.holdout import Holdout
from ballfg.diagnosis.result import Finding, Value
from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Settings, dataset_settings
from ballfg.estimation.noise.estimate import MOST_LOOKS, SETTLED, linearised, spread_over
from ballfg.estimation.noise.tracker_errors import JITTER, MEMORY, NUMBERS, TrackerNoise, TrackerPart, tracker_noise
from ballfg.tracks import Track
from ballfg.tracks.noise import TrackNoise

MOST_TRACKS = 25  # Number of tested tracks of each half, evenly spread
LONGEST_PART, MOST_SAMPLES = 1.0, 100  # s and samples of a tested track: computing time grows with them
SENTENCES = {
    MEMORY: "The tracker's errors last from sample to sample: a part of them fades over the memory's time.",
    JITTER: "Stamps err: each sample was taken a little before or after the moment that is written.",
}
DECIDE = {
    MEMORY: "Track a ball at rest, or one on a straight rail: its measured positions wander together for that time.",
    JITTER: "Film a clock, or take stamps from the camera's own exposures: they lie evenly where arrival times do not.",
}
UNITS = {MEMORY: "m", JITTER: "s"}  # Of `sigma`


@dataclass(frozen=True)
class TrackerErrors:
    """Findings on the tracker, and the noise of its samples with declared memory and jitter, if that is not white."""

    findings: tuple[Finding, ...] = ()
    noise: TrackNoise | None = None


def look_at_tracker(model: AnalyticModel, holdout: Holdout, jobs: int = 1) -> TrackerErrors:
    """The memory and jitter in both halves beside a corrected model with its noise about the tracks."""
    settings = dataset_settings(holdout.dataset, model)
    halves = [spread_over(h, len(h), MOST_TRACKS) for h in (holdout.search_tracks, holdout.held_out_tracks)]
    whole = [part.track for half in halves for part in half]
    ends = [float(min(t.times[0] + LONGEST_PART, t.times[: MOST_SAMPLES + 1][-1])) for t in whole]
    tracks = [track.until(end) for track, end in zip(whole, ends, strict=True)]
    found = _settled(model, holdout, settings, tracks, len(halves[0]), jobs)
    if found is None:
        return TrackerErrors()
    noise, declared = found.noise, settings.has_memory or settings.stamp_jitter > 0.0
    if settings.has_memory:
        noise = replace(noise, memory=settings.memory, memory_time=settings.memory_time)
    if settings.stamp_jitter > 0.0:
        noise = replace(noise, stamp_jitter=settings.stamp_jitter)
    return TrackerErrors(tuple(_finding(part) for part in found.parts), noise if found.parts or declared else None)


def _settled(
    model: AnalyticModel, holdout: Holdout, settings: Settings, tracks: Sequence[Track], searched: int, jobs: int
) -> TrackerNoise | None:
    """The tracker's noise about estimates that know it; None if all tracks are short.

    To an estimate without jitter, stamps that err most look like outliers; without these the jitter looks too small.

    Args: searched: number of the first tracks, of the half that is searched.
    """
    own = any(track.sigmas is not None for track in tracks)
    stated = None if own else holdout.dataset.info.position_noise
    known, found = settings.stamp_jitter, None
    for _ in range(MOST_LOOKS):
        about = replace(settings, stamp_jitter=known)
        linear = linearised(model, holdout.surfaces, about, tracks, jobs=jobs)
        if linear is None:
            return None
        looked = tracker_noise(linear, linear.numbers >= searched, settings, stated)
        jitter = looked.noise.stamp_jitter or 0.0
        if found is not None and not jitter:  # the first look has shown that there is some; others are for its size
            break
        found, before, known = looked, known, jitter
        if settings.stamp_jitter > 0.0 or abs(known - before) <= SETTLED * known:
            break
    return found


def _finding(part: TrackerPart) -> Finding:
    name, searched = part.evidence.name, ~part.held_out
    units = {"sigma": UNITS[name], "time": "s"}
    return Finding(
        name=name,
        kind="measurement",
        parameters={key: Value(value, sigma, units[key]) for key, (value, sigma) in part.values.items()},
        p_value=part.evidence.p_value,
        delta_bic=len(NUMBERS[name]) * float(np.log(searched.sum())) - 2.0 * float(part.gains[searched].sum()),
        indistinguishable_from=(),
        held_out_gain=float(part.gains[part.held_out].mean()),
        held_out_p=part.evidence.halves[1],
        sentence=SENTENCES[name],
        decide=DECIDE[name],
    )
