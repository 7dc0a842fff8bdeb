"""Scores noise by forecasts of linearised tracks, at 20 to 300 ms ahead.

The scatter from sample to sample does not tell how uncertain a forecast 0.3 s ahead is. So noise is scored by its
forecasts: from many origins in every track a Kalman filter forecasts 20 to 300 ms ahead, and the score is the mean
negative logarithm of the density at the later samples (A. P. Dawid, "The prequential approach", 1984), with tails that
grow linearly. The mean of the same for each next sample, the marginal likelihood, is added: it separates parts of the
noise that forecasts leave undetermined.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.deferred import torch
from ballfg.estimation.noise.linear_filter import Filtered, LinearFilter, Noise
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.state import POSITION, STATE_DIM
from ballfg.tracks.stamps import STAMP_TOLERANCE

if TYPE_CHECKING:
    from torch import Tensor

HORIZONS: Final = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
"""s ahead of a start; the first good sample at or after each is scored."""
START_EVERY: Final = 0.05
"""s between two forecast origins in a track."""
EARLIEST_START: Final = 0.2
"""s after the first sample. Before that the start of the track dominates, and no robot acts on it yet."""
TAIL: Final = 3.0
"""Standard deviations of a coordinate beyond which its score grows linearly, so that a missed hit does not dominate."""
NINETY: Final = 1.6448536269514722
"""Standard deviations to each side of a central 90 % interval."""


@dataclass(frozen=True)
class Score:
    """The comparison of forecasts with the measured samples.

    Attributes:
        by_track: (t,) each track's share of the mean negative logarithm of a density, of forecasts and next samples.
        held: share of forecast coordinates inside the central 90 % intervals.
    """

    by_track: Tensor
    held: float

    @property
    def value(self) -> Tensor:
        """() the mean over all tracks."""
        return self.by_track.sum()


class Forecaster:
    """Scores any noise on some linearised tracks.

    Args:
        tracks: linearised.
        velocity_prior: m/s, standard deviation per axis at the start of a track.
        earliest: s after the first sample, of the first forecast origin.
        every: s between origins.
        biased: True if the noise may have a memory.
        next_samples: weight of the next samples beside the forecasts.

    Attributes:
        starts: (r, 2) track and sample of each forecast origin.
    """

    def __init__(
        self,
        tracks: LinearTracks,
        velocity_prior: float,
        earliest: float = EARLIEST_START,
        every: float = START_EVERY,
        *,
        biased: bool = True,
        next_samples: float = 1.0,
    ) -> None:
        self.next_samples = next_samples
        self.tracks, self.filter = tracks, LinearFilter(tracks, velocity_prior, biased=biased)
        self.count, self.samples = tracks.times.shape
        self.starts = self._starts(earliest, every)
        self._ahead = _Ahead.of(tracks, self.starts)

    def _starts(self, earliest: float, every: float) -> Tensor:
        found = []
        for track, (times, used) in enumerate(zip(self.tracks.times.numpy(), self.tracks.used.numpy(), strict=True)):
            last = times[used][-1] if used.any() else 0.0
            moments = np.arange(earliest, last - HORIZONS[0] + STAMP_TOLERANCE, every)
            found += [(track, k) for k in np.unique(np.searchsorted(times, moments - STAMP_TOLERANCE)).tolist()]
        return torch.tensor(found, dtype=torch.int64).reshape(-1, 2)

    def score(self, noise: Noise) -> Score:
        """The score of some noise."""
        measured = self.filter.measured(noise)
        filtered = self.filter.run(noise, measured)
        total, inside, count = self._forecast(filtered, noise, measured)
        by_track = total / max(count, 1) + self.next_samples * filtered.nll / max(filtered.count, 1)
        return Score(by_track, inside / max(3 * count, 1))

    def _forecast(self, filtered: Filtered, noise: Noise, measured: Tensor) -> tuple[Tensor, float, int]:
        """(t,) summed scores of forecasts, number of coordinates in their 90 % intervals, number of forecasts."""
        ahead = self._ahead
        mean, covariance = filtered.means[ahead.track, ahead.start], filtered.covariances[ahead.track, ahead.start]
        process = noise.process.square().expand(self.count, -1)[ahead.track]
        observe, gathered = ahead.by_state, (ahead.kicks @ process[..., None])[..., 0]
        if self.filter.biases:
            time, memory = (x.expand(self.count, *x.shape[1:])[ahead.track] for x in (noise.memory_time, noise.memory))
            decay = torch.exp(-ahead.elapsed / time)
            observe = torch.cat((observe, decay[:, None, None] * torch.eye(3, dtype=torch.float64)), dim=2)
            gathered = gathered + memory * (1.0 - decay.square())[:, None]
        new = torch.diagonal(measured[ahead.track, ahead.sample], dim1=-2, dim2=-1)
        variance = ((observe @ covariance) * observe).sum(dim=2) + gathered + new
        predicted = (observe @ mean[..., None])[..., 0] + ahead.offsets
        square = (self.tracks.errors[ahead.track, ahead.sample] - predicted).square() / variance
        beyond = TAIL * square.clamp(min=1e-12).sqrt() - 0.5 * TAIL**2
        scores = (torch.where(square < TAIL**2, 0.5 * square, beyond) + 0.5 * variance.log()).sum(dim=1)
        total = torch.zeros(self.count, dtype=torch.float64).index_add(0, ahead.track, scores)
        return total, float((square.detach() < NINETY**2).sum()), len(scores)


@dataclass(frozen=True)
class _Ahead:
    """The s scored forecasts, with the parts that do not depend on the noise.

    Attributes:
        track, start, sample: (s,) the track, the sample of the origin, and the forecast sample.
        elapsed: (s,) s between the two.
        by_state: (s, 3, d) derivative of the position by state and coefficients at the origin.
        kicks: (s, 3, 7) m^2, the position's variance per axis for a unit of each number of `PROCESS_NOISE`.
        offsets: (s, 3) m, the sum of the estimate's offsets on the way.
    """

    track: Tensor
    start: Tensor
    sample: Tensor
    elapsed: Tensor
    by_state: Tensor
    kicks: Tensor
    offsets: Tensor

    @classmethod
    def of(cls, tracks: LinearTracks, starts: Tensor) -> _Ahead:
        """All forecasts from some origins (r, 2), track and sample."""
        (track, start), (samples, own) = starts.T, (tracks.times.shape[1], tracks.transitions.shape[-1])
        begin, reached = tracks.times[track, start], torch.zeros(len(track), dtype=torch.float64)
        horizons, found = torch.tensor(HORIZONS, dtype=torch.float64), []
        way = torch.eye(own, dtype=torch.float64).expand(len(track), own, own)
        kicks = torch.zeros((len(track), *tracks.kicks.shape[2:]), dtype=torch.float64)
        shifted = torch.zeros((len(track), own), dtype=torch.float64)
        for ahead in range(1, samples):
            interval = (start + ahead - 1).clamp(max=samples - 2)
            step = tracks.transitions[track, interval]
            moved = step[:, None, :STATE_DIM, :STATE_DIM]
            way, kicks = step @ way, moved @ kicks @ moved.mT + tracks.kicks[track, interval]
            shifted = (step @ shifted[..., None])[..., 0] + tracks.offsets[track, interval]
            sample = (start + ahead).clamp(max=samples - 1)
            elapsed = tracks.times[track, sample] - begin
            fresh = (start + ahead < samples) & tracks.used[track, sample]
            due = ((horizons > reached[:, None]) & (horizons <= elapsed[:, None] + STAMP_TOLERANCE)).any(dim=1)
            rows = torch.nonzero(fresh & due)[:, 0]
            reached = torch.where(fresh, elapsed + STAMP_TOLERANCE, reached)
            gathered = torch.diagonal(kicks[rows][..., POSITION, POSITION], dim1=-2, dim2=-1).mT
            found.append((rows, sample[rows], elapsed[rows], way[rows, POSITION], gathered, shifted[rows, POSITION]))
            if bool((reached >= HORIZONS[-1]).all()):
                break
        rows, *rest = (torch.cat(parts) for parts in zip(*found, strict=True))
        return cls(track[rows], start[rows], *rest)
