"""A dataset ready for diagnosis: every second track to find with, the others to judge by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballfg.diagnosis.fit.stretches import LEAST_SAMPLES, Stretches, stretches_of
from ballfg.diagnosis.search.evaluation import JudgedTrack
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.configure import dataset_settings, dataset_surfaces
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.measurement.as_measured import plainly_measured
from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Dataset, Track

MOST_TRACKS = 200
"""Tracks that are looked at, evenly over the dataset: more cost time in proportion and change no verdict."""
LEAST_TRACKS = 6
"""Fewer leave three to find with: no scatter between tracks to measure noise by."""
LAUNCHER_LABELS = ("topspin", "sidespin", "speed")
"""Launcher settings that a dataset's labels may hold as numbers."""


@dataclass(frozen=True)
class Halves:
    """What is looked at.

    Attributes:
        dataset: where it comes from.
        settings: its noise, as stated or estimated.
        surfaces: where its balls bounce.
        launcher: which labels of a shot tell its spin; its weights mean nothing.
        finding, judging: stretches of the two halves.
        found_on, judged: tracks of the two halves up to their first hit.
        excluded: sentences on what has no part.
    """

    dataset: Dataset
    settings: Settings
    surfaces: Surfaces
    launcher: Launcher
    finding: Stretches
    judging: Stretches
    found_on: tuple[JudgedTrack, ...]
    judged: tuple[JudgedTrack, ...]
    excluded: tuple[str, ...]


def halves_of(dataset: Dataset, model: AnalyticModel, jobs: int, watch: Callable[[str], None]) -> Halves:
    """Split a dataset and find the stretches of both halves.

    Args: dataset: of at least `LEAST_TRACKS` tracks.  model: as declared.  jobs: processes.  watch: told of progress.
    Raises: ValueError: if there are too few tracks.
    """
    tracks, excluded = _chosen(dataset)
    settings, surfaces = dataset_settings(dataset, model), dataset_surfaces(dataset)
    launcher = launcher_labels(dataset, tracks, settings)
    louder = _louder(tracks, settings)
    heard = replace(settings, position_scale=louder * settings.position_scale)
    smoother = Smoother(plainly_measured(model), surfaces, heard)
    watch(f"estimating {len(tracks)} tracks")
    finding, judging = (stretches_of(smoother, half, launcher, jobs) for half in (tracks[::2], tracks[1::2]))
    finding, judging = (replace(half, sigmas=half.sigmas / louder) for half in (finding, judging))
    parts = [list(map_tracks(_JudgedPart(smoother), half, len(half), jobs)) for half in (tracks[::2], tracks[1::2])]
    found_on, judged = (tuple(part for part in half if part is not None) for half in parts)
    lost = len(tracks) - len(np.unique(finding.track)) - len(np.unique(judging.track))
    if lost:
        excluded.append(f"{lost} of {len(tracks)} tracks hold no free flight that is long enough")
    return Halves(dataset, settings, surfaces, launcher, finding, judging, found_on, judged, tuple(excluded))


def _chosen(dataset: Dataset) -> tuple[list[Track], list[str]]:
    count = len(dataset)
    if count < LEAST_TRACKS:
        raise ValueError(
            f"dataset must hold at least {LEAST_TRACKS} tracks, half to find with and half to judge by; got {count}. "
            "Record more."
        )
    kept = set(np.linspace(0, count - 1, min(count, MOST_TRACKS)).round().astype(int).tolist())
    excluded = [] if len(kept) == count else [f"of {count} tracks {len(kept)}, evenly spread, were looked at"]
    return [track for i, track in enumerate(dataset) if i in kept], excluded


def _louder(tracks: Sequence[Track], settings: Settings) -> float:
    """By how much the noise that tracks show exceeds what is stated, at least 1.

    Outliers are told by their distance from where the ball is expected. With less noise expected than there
    is, that would leave out ordinary samples which differ from their neighbours: those that stay err alike, as if a
    force were missing.
    """
    shown = estimate_position_noise(tracks)
    return max(1.0, float(np.max(shown / (settings.position_scale * np.asarray(settings.position_noise)))))


def launcher_labels(dataset: Dataset, tracks: list[Track], settings: Settings) -> Launcher:
    """What tells how tracks without a spin label were launched: settings, else groups, else that they are one set."""
    names = tuple(n for n in LAUNCHER_LABELS if all(isinstance(t.labels.get(n), float) for t in tracks))
    if names:
        return Launcher(SpinEmbedding(names, {}), settings.spin_prior)
    own = dataset.info.name
    groups = tuple(sorted({str(t.labels.get("group", own)) for t in tracks}))
    return Launcher(SpinEmbedding(("group",), {"group": groups}), settings.spin_prior, {"group": own})


@dataclass(frozen=True)
class _JudgedPart:
    """Cuts a track to what a model is to explain; pickles, so that processes can do it."""

    smoother: Smoother

    def __call__(self, track: Track) -> JudgedTrack | None:
        segmentation = self.smoother.segment(track)
        first, last = segmentation.segments[0]
        last = min([last, *(rest.first for rest in segmentation.rests if rest.first >= first)])
        usable = np.flatnonzero(segmentation.usable[: last + 1])
        if len(usable) < LEAST_SAMPLES:
            return None
        sigmas = None if track.sigmas is None else track.sigmas[usable]
        labels = track.labels if usable[0] == 0 else {}
        part = replace(
            track, times=track.times[usable], positions=track.positions[usable], sigmas=sigmas, labels=labels
        )
        bounces = np.array([c.time for c in segmentation.contacts if c.time <= part.times[-1]])
        return JudgedTrack(part, bounces)
