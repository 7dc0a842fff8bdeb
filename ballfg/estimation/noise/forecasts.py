"""Forecasts of linearised tracks under some noise, and how well they keep their promise.

An interval 0.3 s ahead is not decided by the scatter from sample to sample. So noise is scored by what it says about
later samples: from many moments of every track a Kalman filter forecasts 20 to 300 ms ahead, and the score is the mean
negative logarithm of the density of what was then measured (A. P. Dawid, "The prequential approach", 1984), with tails
that grow linearly. The same score of the next sample alone, the marginal likelihood, is added with a small weight: it
tells apart the parts of the noise that forecasts leave open.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ballfg.estimation.noise.linear_filter import Filtered, LinearFilter, Noise, half_square
from ballfg.estimation.noise.linear_tracks import LinearTracks

HORIZONS: Final = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
"""s ahead of a start; the first good sample at or after each is scored."""
START_EVERY: Final = 0.05
"""s between two starts of forecasts in a track."""
EARLIEST_START: Final = 0.2
"""s after the first sample. Before that the start of the track decides, and no robot acts on it yet."""
ROUNDING: Final = 1e-9
"""s. A sample this little before a horizon is at it."""
MARGINAL_WEIGHT: Final = 0.1
TAIL: Final = 3.0
"""Standard deviations of a coordinate beyond which its score grows linearly; a missed hit must not decide the noise."""
NINETY: Final = 1.6448536269514722
"""Standard deviations to each side of a central 90 % interval."""


@dataclass(frozen=True)
class Score:
    """How forecasts compare with what was measured.

    Attributes:
        by_track: (t,) each track's share of the mean negative logarithm of a density, of forecasts and next samples.
        held: share of forecast coordinates inside the central 90 % intervals.
        starts: number of moments that forecasts were made from.
    """

    by_track: Tensor
    held: float
    starts: int

    @property
    def value(self) -> Tensor:
        """() the mean over all tracks."""
        return self.by_track.sum()


class Forecaster:
    """Scores any noise on some linearised tracks.

    Args:
        tracks: linearised.
        velocity_prior: m/s, standard deviation per axis at the start of a track.
        earliest: s after the first sample, of the first start of a forecast.
        every: s between starts.
        biased: whether the noise may have a memory.

    Attributes:
        starts: (r, 2) track and sample from which forecasts are made.
    """

    def __init__(
        self,
        tracks: LinearTracks,
        velocity_prior: float,
        earliest: float = EARLIEST_START,
        every: float = START_EVERY,
        *,
        biased: bool = True,
    ) -> None:
        self.tracks, self.filter = tracks, LinearFilter(tracks, velocity_prior, biased=biased)
        self.count, self.samples = tracks.times.shape
        self.starts = self._starts(earliest, every)
        self._plan = self._scored()

    def _starts(self, earliest: float, every: float) -> Tensor:
        found = []
        for track, (times, used) in enumerate(zip(self.tracks.times.numpy(), self.tracks.used.numpy(), strict=True)):
            last = times[used][-1] if used.any() else 0.0
            moments = np.arange(earliest, last - HORIZONS[0], every)
            found += [(track, k) for k in np.unique(np.searchsorted(times, moments)).tolist()]
        return torch.tensor(found, dtype=torch.int64).reshape(-1, 2)

    def _scored(self) -> list[Tensor]:
        """For each number of samples ahead, the rows of `starts` whose sample there is scored."""
        track, start = self.starts.T
        begin, reached = self.tracks.times[track, start], torch.zeros(len(track), dtype=torch.float64)
        horizons, plan = torch.tensor(HORIZONS, dtype=torch.float64), []
        for ahead in range(1, self.samples):
            sample = (start + ahead).clamp(max=self.samples - 1)
            elapsed = self.tracks.times[track, sample] - begin + ROUNDING
            fresh = (start + ahead < self.samples) & self.tracks.used[track, sample]
            due = ((horizons > reached[:, None]) & (horizons <= elapsed[:, None])).any(dim=1)
            scored = torch.nonzero(fresh & due)[:, 0]
            reached = torch.where(fresh, elapsed, reached)
            plan.append(scored)
            if bool((reached >= HORIZONS[-1]).all()):
                break
        while plan and not len(plan[-1]):
            plan.pop()
        return plan

    def score(self, noise: Noise) -> Score:
        """The score of some noise."""
        transitions, gathered = self.filter.motion(noise)
        measured = self.filter.measured(noise)
        filtered = self.filter.run(noise, transitions, gathered, measured)
        total, inside, count = self._forecast(filtered, transitions, gathered, measured)
        by_track = total / max(count, 1) + MARGINAL_WEIGHT * filtered.following / max(filtered.count, 1)
        return Score(by_track, inside / max(3 * count, 1), len(self.starts))

    def _forecast(
        self, filtered: Filtered, transitions: Tensor, gathered: Tensor, measured: Tensor
    ) -> tuple[Tensor, float, int]:
        """(t,) summed scores of forecasts, coordinates inside their 90 % intervals, and the number of forecasts."""
        observe, (track, start) = self.filter.measure, self.starts.T
        mean, covariance = filtered.means[track, start], filtered.covariances[track, start]
        departures = torch.nn.functional.pad(self.tracks.departures, (0, self.filter.biases))
        intervals = (start[:, None] + torch.arange(len(self._plan))).clamp(max=self.samples - 2)
        steps, added = (x[track[:, None], intervals].unbind(1) for x in (transitions, gathered))
        total, inside, count = torch.zeros(self.count, dtype=torch.float64), 0.0, 0
        for ahead, scored in enumerate(self._plan, start=1):
            step = steps[ahead - 1]
            mean = (step @ mean[..., None])[..., 0] + departures[track, intervals[:, ahead - 1]]
            covariance = step @ covariance @ step.mT + added[ahead - 1]
            if not len(scored):
                continue
            at = track[scored], start[scored] + ahead
            spread = observe @ covariance[scored] @ observe.mT + measured[at]
            variance = torch.diagonal(spread, dim1=-2, dim2=-1)
            square = (self.tracks.errors[at] - mean[scored] @ observe.mT).square() / variance
            scores = (half_square(square, TAIL) + 0.5 * variance.log()).sum(dim=1)
            total = total.index_add(0, track[scored], scores)
            inside += float((square.detach() < NINETY**2).sum())
            count += len(scored)
        return total, inside, count
