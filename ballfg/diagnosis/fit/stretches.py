"""Cuts tracks into stretches, their parts without a hit, and holds them as one padded batch.

The motion of a stretch is deterministic, so what its samples hold beyond it is noise or an effect that the model lacks.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array, Index, Mask
from ballfg.estimation import Smoother
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.launcher import Launcher
from ballfg.tracks import Track

LEAST_SAMPLES = 10
"""Least number of samples: a shorter stretch leaves little information beyond its nine initial values."""
MOST_CONTACTS = 3
"""A stretch ends before the next contact: every further one costs as much as the first and makes the motion more
sensitive to its start, while the last small hops of a ball carry little information."""
LEAST_DURATION = 0.08  # s. A shorter stretch also carries little information
SIMILAR = 1.3  # Ratio of the numbers of samples of stretches that are computed together
TENSORS = ("times", "positions", "sigmas", "starts", "heights", "contacts", "labels")
"""Names of the tensors of `Stretches`."""
PADDING = {"sigmas": math.inf, "heights": math.nan, "contacts": math.nan}
"""Numbers that stand for missing samples and contacts; times and positions repeat the last one."""


@dataclass(frozen=True)
class Stretches:
    """n stretches of at most k samples and c contacts each, padded."""

    names: tuple[str, ...]  # Of the tracks they come from
    track: Index  # (n,) number of the track: stretches of one track count as one observation
    settings: Array  # (n, s) launcher settings, zero if a stretch does not start at the launcher or has none
    times: Tensor  # (n, k) s since the stretch's first sample; the last one repeated
    positions: Tensor  # (n, k, 3) m as measured
    sigmas: Tensor  # (n, k, 3) m, stated noise; infinite for padding
    starts: Tensor  # (n, 9) first guess of the state at the first sample
    heights: Tensor  # (n, c) m, declared height of each contact's surface in order of time; NaN for padding
    contacts: Tensor  # (n, c) s, guesses of their times
    labels: Tensor  # (n, 3) rad/s, spin label at the first sample; NaN without one

    def __len__(self) -> int:
        return len(self.names)

    @property
    def ends(self) -> Tensor:
        """(n,) s, time of the last sample of each."""
        return self.times[:, -1]

    @property
    def used(self) -> Tensor:
        """(n, k) bool, True for samples, False for padding."""
        return self.sigmas[..., 0].isfinite()

    @property
    def labelled(self) -> Mask:
        """(n,) bool, True for stretches with a spin label."""
        return np.asarray(~np.isnan(self.labels[:, 0].numpy()))

    def take(self, rows: Sequence[int] | Index | Mask) -> Self:
        """A part of the stretches."""
        index = np.arange(len(self))[np.asarray(rows)]
        where = torch.from_numpy(index)
        tensors = {name: getattr(self, name)[where] for name in TENSORS}
        names = tuple(self.names[i] for i in index)
        return replace(self, names=names, track=self.track[index], settings=self.settings[index], **tensors)

    def cropped(self, count: int) -> Self:
        """The first `count` samples of each."""
        return replace(self, **{name: getattr(self, name)[:, :count] for name in ("times", "positions", "sigmas")})


def of_similar_length(used: Mask) -> list[tuple[Index, int]]:
    """Rows of stretches with about as many samples, and the number of samples of the longest of them.

    One long stretch would pad all others to its length. Args: used: (n, k) True for samples, which come first.
    """
    counts = used.sum(axis=1)
    sizes = np.ceil(np.log(np.maximum(counts, 1)) / math.log(SIMILAR))
    return [(rows, int(counts[rows].max())) for rows in (np.flatnonzero(sizes == size) for size in np.unique(sizes))]


@dataclass(frozen=True)
class Batch:
    """Stretches of similar length: one long stretch would pad all others to its own."""

    numbers: Index  # (b,) of its stretches among all
    rows: Index  # (m,) numbers of the rows of their samples, then of their spins, among all rows

    def of(self, columns: Array) -> Array:
        """(b, m, ...) the part of columns (n, 3 k + 3, ...)."""
        return columns[np.ix_(self.numbers, self.rows)]


def batches_of(used: Mask) -> list[Batch]:
    """The batches of stretches; used: (n, k) samples that there are."""
    spins = 3 * used.shape[1] + np.arange(3)
    return [Batch(numbers, np.append(np.arange(3 * count), spins)) for numbers, count in of_similar_length(used)]


def stretches_of(smoother: Smoother, tracks: Iterable[Track], launcher: Launcher, jobs: int = 1) -> Stretches:
    """The stretches of tracks.

    The smoother finds contacts, hits and outliers, and initial states for the fit. The launcher reads the settings of a
    shot; its weights are not used.

    Raises: ValueError: if no track has a stretch that is long enough.
    """
    tracks = list(tracks)
    cut = list(map_tracks(partial(_cut, smoother, launcher), tracks, len(tracks), jobs))
    found = [replace(stretch, track=np.array([number])) for number, own in enumerate(cut) for stretch in own]
    if not found:
        raise ValueError(
            f"tracks must hold free flights of at least {LEAST_SAMPLES} samples and {LEAST_DURATION:g} s; none does. "
            "Record longer tracks."
        )
    return joined(found)


def _cut(smoother: Smoother, launcher: Launcher, track: Track) -> list[Stretches]:
    """The stretches of one track, each as a batch of its own."""
    known = launcher.settings(track)
    settings = np.zeros(len(launcher.embedding.names)) if known is None else known
    problem, solution = smoother.solved(track)
    sigma, segmentation = problem.sigma, solution.events.segmentation
    estimate = smoother.result(problem, solution)
    if estimate.status.failed:
        return []
    rests = [rest.first for rest in segmentation.rests]
    stretches = []
    for first, last in segmentation.segments:
        last = min([last, *(rest for rest in rests if first <= rest <= last)])
        usable = first + np.flatnonzero(segmentation.usable[first : last + 1])
        if len(usable) < LEAST_SAMPLES or track.times[usable[-1]] - track.times[usable[0]] < LEAST_DURATION:
            continue
        begin, end = float(track.times[usable[0]]), track.times[usable[-1]]
        met = [c for c in estimate.contacts if usable[0] <= c.interval < usable[-1] and begin < c.time < end]
        if len(met) > MOST_CONTACTS:
            usable = usable[usable <= met[MOST_CONTACTS].interval]
            end, met = track.times[usable[-1]], met[:MOST_CONTACTS]
        launched = usable[0] == 0
        rows = {
            "times": track.times[usable] - begin,
            "positions": track.positions[usable],
            "sigmas": sigma[usable],
            "starts": estimate.states[usable[0]],
            "heights": np.array([c.height for c in met], dtype=np.float64),
            "contacts": np.array([c.time - begin for c in met], dtype=np.float64),
            "labels": track.spin_label if launched and track.spin_label is not None else np.full(3, np.nan),
        }
        tensors = {name: torch.from_numpy(row).unsqueeze(0) for name, row in rows.items()}
        own = settings if launched else np.zeros_like(settings)
        stretches.append(Stretches((track.name,), np.zeros(1, dtype=np.int64), own[None], **tensors))
    return stretches


def joined(parts: Sequence[Stretches]) -> Stretches:
    """Several batches of stretches as one, padded to the longest."""
    tensors = {}
    for name in TENSORS:
        own = [getattr(part, name) for part in parts]
        length = max(tensor.shape[1] for tensor in own)
        tensors[name] = torch.cat([_padded(tensor, length, PADDING.get(name)) for tensor in own])
    names = tuple(name for part in parts for name in part.names)
    track, settings = (np.concatenate([getattr(part, name) for part in parts]) for name in ("track", "settings"))
    return Stretches(names, track, settings, **tensors)


def _padded(rows: Tensor, length: int, fill: float | None) -> Tensor:
    """Rows (n, m, ...) extended to a length, by a number or by the last of each."""
    missing = (len(rows), length - rows.shape[1], *rows.shape[2:])
    rest = rows[:, -1:].expand(missing) if fill is None else rows.new_full(missing, fill)
    return torch.cat((rows, rest), dim=1)
