"""Splits a dataset for diagnosis: every second track to search for effects, the others held out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.stamps import Stamps, look_at_stamps
from ballfg.diagnosis.fit.stretches import LEAST_SAMPLES, Stretches, stretches_of
from ballfg.dynamics import AnalyticModel, BallModel, Surfaces
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.estimation import Settings, Smoother, dataset_settings, dataset_surfaces
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.measurement.as_measured import plainly_measured
from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.state import STANDARD_GRAVITY
from ballfg.tracks import Dataset, Track

MOST_TRACKS = 200
"""Largest number of tracks, evenly over the dataset. Computing time grows with it; verdicts do not change."""
LEAST_TRACKS = 6
"""Least number of tracks: with fewer, the search half has fewer than three, too few to measure the noise."""
USUAL = {"flight.gravity.g": STANDARD_GRAVITY, "flight.drag.k": 0.12}
"""Gravity and drag by parameter name, for a model without them."""
LAUNCHER_LABELS = ("topspin", "sidespin", "speed")  # Launcher settings that labels may hold as numbers


@dataclass(frozen=True)
class EvaluationTrack:
    """The part of a track for evaluating a model: up to the first hit or rest, without outliers; bounces (b,) s."""

    track: Track
    bounces: Array


@dataclass(frozen=True)
class Holdout:
    """A dataset in two halves."""

    dataset: Dataset  # The whole
    settings: Settings  # Its noise, as stated or estimated
    surfaces: Surfaces  # Where its balls bounce
    launcher: Launcher  # Names the labels of a shot that give its spin; its weights are not used
    search: Stretches  # Of the search half
    held_out: Stretches  # Of the other half
    search_tracks: tuple[EvaluationTrack, ...]  # Of the search half, up to their first hit
    held_out_tracks: tuple[EvaluationTrack, ...]  # Of the other half, up to their first hit
    tracks: tuple[Track, ...]  # Of both halves, whole and in the order of the recording
    stamps: Stamps  # Errors of the stamps of all tracks; the stretches have corrected frames
    excluded: tuple[str, ...]  # Sentences on unused tracks


def analytic(model: BallModel) -> AnalyticModel:
    """The model itself. Raises: TypeError: if it is a learned one."""
    if not isinstance(model, AnalyticModel):
        raise TypeError(
            f"model must be an AnalyticModel, to which effects can be added; got {type(model).__name__}. "
            "Diagnose its analytic part."
        )
    return model


def hold_out(
    dataset: Dataset,
    model: AnalyticModel,
    jobs: int = 1,
    watch: Callable[[str], None] | None = None,
    *,
    most_tracks: int = MOST_TRACKS,
) -> Holdout:
    """Splits a dataset in two and finds the stretches of both halves.

    Args:
        dataset: of at least `LEAST_TRACKS` tracks.
        model: as declared.
        jobs: processes.
        watch: called with lines of progress.
        most_tracks: largest number of tracks, evenly spread over a larger dataset.
    Returns: both halves, as stretches to fit and as tracks to predict.
    Raises: ValueError: if there are too few tracks, or a half without a stretch that is long enough.
    """
    tracks, excluded = _chosen(dataset, most_tracks)
    settings, surfaces = dataset_settings(dataset, model), dataset_surfaces(dataset)
    launcher = launcher_labels(dataset, tracks, settings)
    stamps = stamps_of(tracks, model)
    written = {track.name: track for track in tracks}
    tracks = [stamps.repaired(track) for track in tracks]
    named = {track.name: track for track in tracks}
    excess = _excess_noise(tracks, settings)
    noisy = replace(settings, position_scale=excess * settings.position_scale)
    smoother = Smoother(plainly_measured(model), surfaces, noisy)
    if watch is not None:
        watch(f"estimating {len(tracks)} tracks")
    halves = tracks[::2], tracks[1::2]
    found = [stretches_of(smoother, half, launcher, jobs) for half in halves]
    search, held_out = (replace(half, sigmas=half.sigmas / excess, times=half.times / stamps.stretch) for half in found)
    parts = [map_tracks(partial(_evaluation_track, smoother), half, len(half), jobs) for half in halves]
    search_tracks, held_out_tracks = (
        tuple(_as_written(p, named[p.track.name], written[p.track.name]) for p in half if p is not None)
        for half in parts
    )
    lost = len(tracks) - len(np.unique(search.track)) - len(np.unique(held_out.track))
    if lost:
        excluded.append(f"{lost} of {len(tracks)} tracks hold no free flight that is long enough")
    return Holdout(
        dataset,
        settings,
        surfaces,
        launcher,
        search,
        held_out,
        search_tracks,
        held_out_tracks,
        tuple(tracks),
        stamps,
        tuple(excluded),
    )


def stamps_of(tracks: Sequence[Track], model: AnalyticModel) -> Stamps:
    """Errors of the stamps of tracks; none if the model describes the stamps."""
    if {"time_scale", "counted_frames"} & set(model.measurement):
        return Stamps()
    values = {name: value.detach() for name, value in model.named_parameters()}
    gravity, drag = (float(values[name]) if name in values else usual for name, usual in USUAL.items())
    return look_at_stamps(tracks, gravity, drag)


def _as_written(part: EvaluationTrack, repaired: Track, written: Track) -> EvaluationTrack:
    """A part of a track with repaired stamps, with its original stamps."""
    if repaired is written:
        return part
    times = written.times[np.searchsorted(repaired.times, part.track.times)]
    bounces = np.interp(part.bounces, repaired.times, written.times)
    return EvaluationTrack(replace(part.track, times=times), bounces)


def _chosen(dataset: Dataset, most: int) -> tuple[list[Track], list[str]]:
    count = len(dataset)
    if count < LEAST_TRACKS:
        raise ValueError(
            f"dataset must hold at least {LEAST_TRACKS} tracks, half to find with and half to judge by; got {count}. "
            "Record more."
        )
    kept = set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist())
    excluded = [] if len(kept) == count else [f"of {count} tracks {len(kept)}, evenly spread, were looked at"]
    return [track.since_first() for i, track in enumerate(dataset) if i in kept], excluded


def _excess_noise(tracks: Sequence[Track], settings: Settings) -> float:
    """Noise of the tracks over the stated noise, at least 1.

    If the stated noise is too small, ordinary samples that differ from their neighbours would count as outliers, and
    the errors of the others would be alike, as if a force were missing.
    """
    shown = estimate_position_noise(tracks)
    return max(1.0, float(np.max(shown / (settings.position_scale * np.asarray(settings.position_noise)))))


def launcher_labels(dataset: Dataset, tracks: list[Track], settings: Settings) -> Launcher:
    """The labels that give the launch of unlabelled spins: settings, else groups, else one group for all."""
    names = tuple(n for n in LAUNCHER_LABELS if all(isinstance(t.labels.get(n), float) for t in tracks))
    if names:
        return Launcher(SpinEmbedding(names, {}), settings.spin_prior)
    own = dataset.info.name
    groups = tuple(sorted({str(t.labels.get("group", own)) for t in tracks}))
    return Launcher(SpinEmbedding(("group",), {"group": groups}), settings.spin_prior, {"group": own})


def _evaluation_track(smoother: Smoother, track: Track) -> EvaluationTrack | None:
    """The part of a track for evaluating a model; None if it has too few samples."""
    segmentation = smoother.segment(track)
    first, last = segmentation.segments[0]
    last = min([last, *(rest.first for rest in segmentation.rests if rest.first >= first)])
    usable = np.flatnonzero(segmentation.usable[: last + 1])
    if len(usable) < LEAST_SAMPLES:
        return None
    sigmas = None if track.sigmas is None else track.sigmas[usable]
    labels = track.labels if usable[0] == 0 else {}
    part = replace(track, times=track.times[usable], positions=track.positions[usable], sigmas=sigmas, labels=labels)
    bounces = np.array([c.time for c in segmentation.contacts if c.time <= part.times[-1]])
    return EvaluationTrack(part, bounces)
