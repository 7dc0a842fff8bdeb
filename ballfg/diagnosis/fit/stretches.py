"""What a diagnosis fits: stretches of tracks without a hit, as one padded batch.

A stretch starts at its first usable sample with a state of its own, flies and bounces at contacts whose order is known,
and ends before the next hit or when the ball comes to rest. Deterministic motion from its first state is all that a
model claims; what the samples hold beyond it is noise or something that the model lacks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ballfg.estimation.batch import map_tracks
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.segmentation import Contact
from ballfg.estimation.smoother.problem import effective_sigmas
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.state import STATE_DIM
from ballfg.tracks import Track

LEAST_SAMPLES = 10
"""A stretch of fewer samples tells next to nothing once its nine start values are found."""
LEAST_DURATION = 0.08
"""s. The same for short ones."""

Array = NDArray[np.float64]


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
    track: NDArray[np.int64]
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
    def labelled(self) -> NDArray[np.bool_]:
        """(n,) whether each has a spin label."""
        return np.asarray(~np.isnan(self.labels[:, 0].numpy()))

    def take(self, rows: Sequence[int] | NDArray[np.int64] | NDArray[np.bool_]) -> Stretches:
        """Some of the stretches."""
        index = np.arange(len(self))[np.asarray(rows)]
        where = torch.from_numpy(index)
        fields = ("times", "positions", "sigmas", "starts", "heights", "contacts", "labels")
        tensors = {name: getattr(self, name)[where] for name in fields}
        return Stretches(tuple(self.names[i] for i in index), self.track[index], self.settings[index], **tensors)


@dataclass(frozen=True)
class _Stretch:
    """One of them, not padded yet."""

    name: str
    track: int
    settings: Array
    times: Array
    positions: Array
    sigmas: Array
    start: Array
    contacts: tuple[Contact, ...]
    label: Array | None


def stretches_of(smoother: Smoother, tracks: Iterable[Track], launcher: Launcher, jobs: int = 1) -> Stretches:
    """The stretches of tracks.

    Args:
        smoother: finds contacts, hits and outliers, and the states from which the fit starts.
        tracks: as measured.
        launcher: what the settings of a shot are; its weights do not matter.
        jobs: processes.
    Raises: ValueError: if no track has a stretch that is long enough.
    """
    tracks = list(tracks)
    found = [
        stretch
        for number, stretches in enumerate(map_tracks(partial(_cut, smoother, launcher), tracks, len(tracks), jobs))
        for stretch in (replace(s, track=number) for s in stretches)
    ]
    if not found:
        raise ValueError(
            f"tracks must hold free flights of at least {LEAST_SAMPLES} samples and {LEAST_DURATION:g} s; none does. "
            "Record longer tracks."
        )
    return _padded(found)


def _cut(smoother: Smoother, launcher: Launcher, track: Track) -> list[_Stretch]:
    known = launcher.settings(track)
    settings = np.zeros(len(launcher.embedding.names)) if known is None else known
    segmentation = smoother.segment(track)
    sigma = effective_sigmas(track, segmentation, smoother.settings)
    solution = smoother.solve(smoother.problem(track, segmentation, sigma))
    estimate, segmentation = smoother.result(track, sigma, solution), solution.events.segmentation
    rests = [rest.first for rest in segmentation.rests]
    stretches = []
    for first, last in segmentation.segments:
        last = min([last, *(rest for rest in rests if first <= rest <= last)])
        usable = first + np.flatnonzero(segmentation.usable[first : last + 1])
        if len(usable) < LEAST_SAMPLES or track.times[usable[-1]] - track.times[usable[0]] < LEAST_DURATION:
            continue
        begin = float(track.times[usable[0]])
        contacts = tuple(
            Contact(c.interval, c.time - begin, c.height)
            for c in estimate.contacts
            if usable[0] <= c.interval < usable[-1] and begin < c.time < track.times[usable[-1]]
        )
        labelled = usable[0] == 0 and track.spin_label is not None
        stretches.append(
            _Stretch(
                name=track.name,
                track=0,
                settings=settings if usable[0] == 0 else np.zeros_like(settings),
                times=track.times[usable] - begin,
                positions=track.positions[usable],
                sigmas=sigma[usable],
                start=estimate.states[usable[0]],
                contacts=contacts,
                label=track.spin_label if labelled else None,
            )
        )
    return stretches


def _padded(found: Sequence[_Stretch]) -> Stretches:
    n, k = len(found), max(len(s.times) for s in found)
    c = max(len(s.contacts) for s in found)
    times, positions = np.zeros((n, k)), np.zeros((n, k, 3))
    sigmas = np.full((n, k, 3), np.inf)
    heights, contacts, labels = np.full((n, c), np.nan), np.full((n, c), np.nan), np.full((n, 3), np.nan)
    starts = np.zeros((n, STATE_DIM))
    for i, s in enumerate(found):
        m = len(s.times)
        times[i, :m], times[i, m:] = s.times, s.times[-1]
        positions[i, :m], positions[i, m:] = s.positions, s.positions[-1]
        sigmas[i, :m] = s.sigmas
        starts[i] = s.start
        for j, contact in enumerate(s.contacts):
            heights[i, j], contacts[i, j] = contact.height, contact.time
        if s.label is not None:
            labels[i] = s.label
    return Stretches(
        tuple(s.name for s in found),
        np.array([s.track for s in found]),
        np.stack([s.settings for s in found]),
        *(torch.from_numpy(a) for a in (times, positions, sigmas, starts, heights, contacts, labels)),
    )
