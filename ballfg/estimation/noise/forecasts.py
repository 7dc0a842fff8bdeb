"""Scores noise by forecasts of linearised tracks, at 20 to 300 ms ahead.

The scatter from sample to sample does not tell how uncertain a forecast 0.3 s ahead is. So noise is scored by its
forecasts: from many origins in every track a Kalman filter forecasts 20 to 300 ms ahead, and the score is the mean
negative logarithm of the density at the later samples (A. P. Dawid, "The prequential approach", 1984), with tails that
grow linearly. The mean of the same for each next sample, the marginal likelihood, is added: it separates parts of the
noise that forecasts leave undetermined.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.estimation.noise.linear_filter import Filtered, LinearFilter, Noise
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.state import POSITION, STATE_DIM
from ballfg.tracks.stamps import STAMP_TOLERANCE

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
        derivatives: computes `slopes`, which take longer than the score.
    """

    by_track: Array
    held: float
    derivatives: Callable[[], Noise]

    @property
    def value(self) -> float:
        """The mean over all tracks."""
        return float(self.by_track.sum())

    @cached_property
    def slopes(self) -> Noise:
        """The derivatives of `by_track` by the noise, a row for each track."""
        return self.derivatives()


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

    def _starts(self, earliest: float, every: float) -> Index:
        found = []
        for track, (times, used) in enumerate(zip(self.tracks.times, self.tracks.used, strict=True)):
            last = times[used][-1] if used.any() else 0.0
            moments = np.arange(earliest, last - HORIZONS[0] + STAMP_TOLERANCE, every)
            found += [(track, k) for k in np.unique(np.searchsorted(times, moments - STAMP_TOLERANCE)).tolist()]
        return np.array(found, dtype=np.int64).reshape(-1, 2)

    def score(self, noise: Noise) -> Score:
        """The score of some noise."""
        measured = self.filter.measured(noise)
        filtered = self.filter.run(noise, measured)
        looked, weight = self._look(filtered, noise, measured), self.next_samples / max(filtered.count, 1)
        count = max(len(looked.scores), 1)
        by_track = np.bincount(self._ahead.track, looked.scores, self.count) / count + weight * filtered.nll
        derivatives = partial(self._slopes, filtered, noise, looked, count, weight)
        return Score(by_track, looked.inside / (3 * count), derivatives)

    def _look(self, filtered: Filtered, noise: Noise, measured: Array) -> _Looked:
        """All forecasts beside what was measured."""
        ahead, own = self._ahead, self.filter.own
        mean, covariance = filtered.means[ahead.track, ahead.start], filtered.covariances[ahead.track, ahead.start]
        variance = np.einsum("saq,sq->sa", ahead.kicks, filtered.variances.process[ahead.track])
        observe, decay = ahead.by_state, np.zeros(len(mean))
        if self.filter.biases:
            decay = np.exp(-ahead.elapsed / np.broadcast_to(noise.memory_time, self.count)[ahead.track])
            observe = np.concatenate((observe, decay[:, None, None] * np.eye(3)), axis=2)
            variance += filtered.variances.memory[ahead.track] * (1.0 - decay**2)[:, None]
        known = observe @ covariance
        variance += (known * observe).sum(axis=2) + np.diagonal(measured[ahead.track, ahead.sample], axis1=1, axis2=2)
        predicted = (observe @ mean[..., None])[..., 0] + ahead.offsets
        error = self.tracks.errors[ahead.track, ahead.sample] - predicted
        square = error**2 / variance
        near, size = square < TAIL**2, np.sqrt(np.maximum(square, 1e-12))
        scores = np.where(near, 0.5 * square, TAIL * size - 0.5 * TAIL**2) + 0.5 * np.log(variance)
        slope = np.where(near, 0.5, 0.5 * TAIL / size)  # by the square
        by_predicted, by_variance = -2.0 * slope * error / variance, (0.5 - slope * square) / variance
        by_observe = by_predicted[..., None] * mean[:, None, :] + 2.0 * by_variance[..., None] * known
        by_decay = by_observe[:, range(3), range(own, own + 3)].sum(axis=1) if self.filter.biases else decay
        inside = float((square < NINETY**2).sum())
        return _Looked(scores.sum(axis=1), inside, observe, decay, by_predicted, by_variance, by_decay)

    def _slopes(self, filtered: Filtered, noise: Noise, looked: _Looked, count: int, weight: float) -> Noise:
        """The derivatives of the score by the noise. Args: weight: of the densities of the next samples."""
        ahead, share = self._ahead, 1.0 / count
        by_variance = share * looked.by_variance
        by_means, by_covariances = np.zeros(filtered.means.shape), np.zeros(filtered.covariances.shape)
        own = share * np.einsum("saw,sa->sw", looked.observe, looked.by_predicted)
        weighted = (looked.observe * by_variance[..., None]).swapaxes(1, 2) @ looked.observe
        for rows in ahead.apart:
            by_means[ahead.track[rows], ahead.start[rows]] += own[rows]
            by_covariances[ahead.track[rows], ahead.start[rows]] += weighted[rows]
        by, by_decays = self.filter.slopes(filtered, weight, (by_means, by_covariances))
        for rows in ahead.apart:
            by.measured[ahead.track[rows, None], ahead.sample[rows, None], range(3), range(3)] += by_variance[rows]
        np.add.at(by.process, ahead.track, np.einsum("sa,saq->sq", by_variance, ahead.kicks))
        decay, memory = looked.decay, filtered.variances.memory[ahead.track]
        if self.filter.biases:
            np.add.at(by.memory, ahead.track, by_variance * (1.0 - decay**2)[:, None])
        found = self.filter.noise_slopes(noise, filtered, by, by_decays)
        if not self.filter.biases:
            return found
        late = share * looked.by_decay - 2.0 * decay * (by_variance * memory).sum(axis=1)
        through = np.bincount(ahead.track, late * decay * ahead.elapsed, self.count) / noise.memory_time**2
        return replace(found, memory_time=found.memory_time + through)


class _Looked(NamedTuple):
    """What comes of s forecasts.

    Attributes:
        scores: (s,).  inside: number of coordinates in their 90 % intervals.
        observe: (s, 3, w) derivative of the position by the filter's state.  decay: (s,) of the memory.
        by_predicted, by_variance, by_decay: (s, 3), (s, 3) and (s,) derivatives of the scores by the predicted
            position, its variance, and the decay as it stands in `observe`.
    """

    scores: Array
    inside: float
    observe: Array
    decay: Array
    by_predicted: Array
    by_variance: Array
    by_decay: Array


@dataclass(frozen=True)
class _Ahead:
    """The s scored forecasts, with the parts that do not depend on the noise.

    Attributes:
        track, start, sample: (s,) the track, the sample of the origin, and the forecast sample.
        elapsed: (s,) s between the two.
        by_state: (s, 3, d) derivative of the position by state and coefficients at the origin.
        kicks: (s, 3, 7) m^2, the position's variance per axis for a unit of each number of `PROCESS_NOISE`.
        offsets: (s, 3) m, the sum of the estimate's offsets on the way.
        apart: the s forecasts in parts, in each of which no two have an origin or a forecast sample in common.
    """

    track: Index
    start: Index
    sample: Index
    elapsed: Array
    by_state: Array
    kicks: Array
    offsets: Array
    apart: list[slice]

    @classmethod
    def of(cls, tracks: LinearTracks, starts: Index) -> _Ahead:
        """All forecasts from some origins (r, 2), track and sample."""
        (track, start), (samples, own) = starts.T, (tracks.times.shape[1], tracks.transitions.shape[-1])
        begin, reached, horizons, found = tracks.times[track, start], np.zeros(len(track)), np.array(HORIZONS), []
        way, shifted = np.tile(np.eye(own), (len(track), 1, 1)), np.zeros((len(track), own))
        fresh_kicks = np.ascontiguousarray(tracks.kicks.swapaxes(2, 3))  # (t, n - 1, 9, 7, 9): few large products
        kicks = np.zeros((len(track), *fresh_kicks.shape[2:]))
        for ahead in range(1, samples):
            interval = np.minimum(start + ahead - 1, samples - 2)
            step = tracks.transitions[track, interval]
            moved = step[:, :STATE_DIM, :STATE_DIM]
            kicks = (moved @ kicks.reshape(len(track), STATE_DIM, -1)).reshape(len(track), -1, STATE_DIM)
            kicks = (kicks @ moved.swapaxes(-1, -2)).reshape(len(track), *fresh_kicks.shape[2:])
            kicks += fresh_kicks[track, interval]
            way = step @ way
            shifted = (step @ shifted[..., None])[..., 0] + tracks.offsets[track, interval]
            sample = np.minimum(start + ahead, samples - 1)
            elapsed = tracks.times[track, sample] - begin
            fresh = (start + ahead < samples) & tracks.used[track, sample]
            due = ((horizons > reached[:, None]) & (horizons <= elapsed[:, None] + STAMP_TOLERANCE)).any(axis=1)
            rows = np.flatnonzero(fresh & due)
            reached = np.where(fresh, elapsed + STAMP_TOLERANCE, reached)
            gathered = np.diagonal(kicks[rows][:, POSITION, :, POSITION], axis1=1, axis2=3).swapaxes(-1, -2)
            found.append((rows, sample[rows], elapsed[rows], way[rows, POSITION], gathered, shifted[rows, POSITION]))
            if (reached >= HORIZONS[-1]).all():
                break
        rows, sample, elapsed, by_state, kicks, offsets = (np.concatenate(one) for one in zip(*found, strict=True))
        ends = np.cumsum([0, *(len(parts[0]) for parts in found)]).tolist()
        apart = [slice(*part) for part in pairwise(ends)]
        return cls(track[rows], start[rows], sample, elapsed, by_state, kicks, offsets, apart)
