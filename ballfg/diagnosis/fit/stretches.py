"""Stretches: parts of tracks without a hit, as one padded batch.

A stretch starts at its first usable sample with a state of its own. The ball flies and bounces at contacts whose order
is known. The stretch ends before the next hit or when the ball comes to rest. The motion is deterministic, so what the
samples hold beyond it is noise or an effect that the model lacks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ballfg.diagnosis.result import Array, Index, Mask
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.smoother.problem import effective_sigmas
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track

LEAST_SAMPLES = 10
"""A stretch of fewer samples tells next to nothing once its nine start values are found."""
LEAST_DURATION = 0.08
"""s. A shorter stretch tells next to nothing either."""


@dataclass(frozen=True)
class Stretches:
    """n stretches of at most k samples and c contacts each, padded.

    Attributes:
        names: of the tracks they come from.
        track: (n,) number of the track: stretches of one track count as one observation.
        settings: (n, s) launcher settings, zero where a stretch does not start at the launcher or tells none.
        times: (n, k) s since the stretch's first sample; the last one repeated.
        positions: (n, k, 3) m as measured.
        sigmas: (n, k, 3) m, stated noise; infinite where there is no sample.
        starts: (n, 9) first guess of the state at the first sample.
        heights: (n, c) m, declared height of each contact's surface in order of time; NaN where there is none.
        contacts: (n, c) s, guesses of when they happen.
        labels: (n, 3) rad/s, spin label at the first sample; NaN without one.
    """

    names: tuple[str, ...]
    track: Index
    settings: Array
    times: Tensor
    positions: Tensor
    sigmas: Tensor
    starts: Tensor
    heights: Tensor
    contacts: Tensor
    labels: Tensor

    def __len__(self) -> int:
        return len(self.names)

    @property
    def ends(self) -> Tensor:
        """(n,) s, last sample of each."""
        return self.times[:, -1]

    @property
    def used(self) -> Tensor:
        """(n, k) bool, there is a sample."""
        return self.sigmas[..., 0].isfinite()

    @property
    def labelled(self) -> Mask:
        """(n,) whether each has a spin label."""
        return np.asarray(~np.isnan(self.labels[:, 0].numpy()))

    def take(self, rows: Sequence[int] | Index | Mask) -> Stretches:
        """Some of the stretches."""
        index = np.arange(len(self))[np.asarray(rows)]
        where = torch.from_numpy(index)
        fields = ("times", "positions", "sigmas", "starts", "heights", "contacts", "labels")
        tensors = {name: getattr(self, name)[where] for name in fields}
        return Stretches(tuple(self.names[i] for i in index), self.track[index], self.settings[index], **tensors)


@dataclass(frozen=True)
class _Stretch:
    """One stretch, not padded yet: fields as in `Stretches`."""

    name: str
    settings: Array
    times: Array
    positions: Array
    sigmas: Array
    start: Array
    heights: Array
    contacts: Array
    label: Array


def stretches_of(smoother: Smoother, tracks: Iterable[Track], launcher: Launcher, jobs: int = 1) -> Stretches:
    """The stretches of tracks.

    Args:
        smoother: finds contacts, hits and outliers, and the states from which the fit starts.
        tracks: as measured.
        launcher: reads the settings of a shot; its weights do not matter.
        jobs: processes.

    Raises:
        ValueError: if no track has a stretch that is long enough.
    """
    tracks = list(tracks)
    cut = list(map_tracks(partial(_cut, smoother, launcher), tracks, len(tracks), jobs))
    found = [stretch for stretches in cut for stretch in stretches]
    if not found:
        raise ValueError(
            f"tracks must hold free flights of at least {LEAST_SAMPLES} samples and {LEAST_DURATION:g} s; none does. "
            "Record longer tracks."
        )
    return _batch(found, np.repeat(np.arange(len(cut)), [len(stretches) for stretches in cut]))


def _cut(smoother: Smoother, launcher: Launcher, track: Track) -> list[_Stretch]:
    known = launcher.settings(track)
    settings = np.zeros(len(launcher.embedding.names)) if known is None else known
    segmentation = smoother.segment(track)
    sigma = effective_sigmas(track, segmentation, smoother.settings)
    solution = smoother.solve(track, segmentation, sigma)
    estimate, segmentation = smoother.result(track, sigma, solution), solution.events.segmentation
    rests = [rest.first for rest in segmentation.rests]
    stretches = []
    for first, last in segmentation.segments:
        last = min([last, *(rest for rest in rests if first <= rest <= last)])
        usable = first + np.flatnonzero(segmentation.usable[first : last + 1])
        if len(usable) < LEAST_SAMPLES or track.times[usable[-1]] - track.times[usable[0]] < LEAST_DURATION:
            continue
        begin, end = float(track.times[usable[0]]), track.times[usable[-1]]
        met = [c for c in estimate.contacts if usable[0] <= c.interval < usable[-1] and begin < c.time < end]
        launched = usable[0] == 0
        stretches.append(
            _Stretch(
                name=track.name,
                settings=settings if launched else np.zeros_like(settings),
                times=track.times[usable] - begin,
                positions=track.positions[usable],
                sigmas=sigma[usable],
                start=estimate.states[usable[0]],
                heights=np.array([c.height for c in met], dtype=np.float64),
                contacts=np.array([c.time - begin for c in met], dtype=np.float64),
                label=track.spin_label if launched and track.spin_label is not None else np.full(3, np.nan),
            )
        )
    return stretches


def _batch(found: Sequence[_Stretch], track: Index) -> Stretches:
    samples, contacts = max(len(s.times) for s in found), max(len(s.contacts) for s in found)
    padded = {
        "times": [_padded(s.times, samples) for s in found],
        "positions": [_padded(s.positions, samples) for s in found],
        "sigmas": [_padded(s.sigmas, samples, np.inf) for s in found],
        "starts": [s.start for s in found],
        "heights": [_padded(s.heights, contacts, np.nan) for s in found],
        "contacts": [_padded(s.contacts, contacts, np.nan) for s in found],
        "labels": [s.label for s in found],
    }
    tensors = {name: torch.from_numpy(np.stack(rows)) for name, rows in padded.items()}
    return Stretches(tuple(s.name for s in found), track, np.stack([s.settings for s in found]), **tensors)


def _padded(rows: Array, length: int, fill: float | None = None) -> Array:
    """Rows (m, ...) continued to a length, with a number or else with the last row."""
    width = [(0, length - len(rows))] + [(0, 0)] * (rows.ndim - 1)
    return np.pad(rows, width, "edge") if fill is None else np.pad(rows, width, constant_values=fill)
