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

from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.state import POSITION, STATE_DIM

BIAS_DIM: Final = 3
HORIZONS: Final = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
"""s ahead of a start; the first good sample at or after each is scored."""
START_EVERY: Final = 0.05
"""s between two starts of forecasts in a track."""
EARLIEST_START: Final = 0.2
"""s after the first sample. Before that the start of the track decides, and no robot acts on it yet."""
ROUNDING: Final = 1e-9
"""s. A sample this little before a horizon is at it."""
MARGINAL_WEIGHT: Final = 0.1
NEXT_FROM: Final = 3
"""Samples that determine a state; the marginal likelihood counts those after them."""
GATE: Final = 30.0
"""Squared whitened innovation of three coordinates; beyond it, one in a million, a sample does not update."""
TAIL: Final = 3.0
"""Standard deviations of a coordinate beyond which its score grows linearly; a missed hit must not decide the noise."""
NEXT_TAIL: Final = 4.0
"""The same for the norm of three coordinates of the next sample."""


@dataclass(frozen=True)
class Noise:
    """All noise as tensors, differentiable.

    Attributes:
        position: (3,) multiples of the white standard deviations of the samples.
        memory: (3,) m.  memory_time: () s.  stamp_jitter: () s.
        process: (7,) the numbers of `PROCESS_NOISE`.
        spin_label, spin_prior: () rad/s.
        coefficients: () multiple of their prior standard deviations.
    """

    position: Tensor
    memory: Tensor
    memory_time: Tensor
    stamp_jitter: Tensor
    process: Tensor
    spin_label: Tensor
    spin_prior: Tensor
    coefficients: Tensor


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

    Attributes:
        starts: (r, 2) track and sample from which forecasts are made.
    """

    def __init__(
        self,
        tracks: LinearTracks,
        velocity_prior: float,
        earliest: float = EARLIEST_START,
        every: float = START_EVERY,
    ) -> None:
        self.tracks, self.velocity_prior = tracks, velocity_prior
        self.count, self.samples = tracks.times.shape
        self.own = tracks.transitions.shape[-1]
        self.width = self.own + BIAS_DIM
        self.measure = torch.zeros((3, self.width), dtype=torch.float64)
        self.measure[:, POSITION] = self.measure[:, self.own :] = torch.eye(3, dtype=torch.float64)
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
        transitions, gathered = self._motion(noise)
        measured = self._measurement(noise)
        means, covariances, following, nexts = self._filter(noise, transitions, gathered, measured)
        total, inside, count = self._forecast(means, covariances, transitions, gathered, measured)
        by_track = total / max(count, 1) + MARGINAL_WEIGHT * following / max(nexts, 1)
        return Score(by_track, inside / max(3 * count, 1), len(self.starts))

    def _motion(self, noise: Noise) -> tuple[Tensor, Tensor]:
        """(t, n - 1, w, w) transitions and covariances gathered, of state, coefficients and biases."""
        times = self.tracks.times
        decay = torch.exp(-torch.diff(times, dim=1) / noise.memory_time)
        axes = torch.arange(self.own, self.width)
        shape = (self.count, self.samples - 1, self.width, self.width)
        transitions, gathered = (torch.zeros(shape, dtype=torch.float64) for _ in range(2))
        transitions[..., : self.own, : self.own] = self.tracks.transitions
        transitions[..., axes, axes] = decay[..., None]
        gathered[..., :STATE_DIM, :STATE_DIM] = torch.einsum("k,tnkij->tnij", noise.process.square(), self.tracks.kicks)
        gathered[..., axes, axes] = noise.memory.square() * (1.0 - decay.square())[..., None]
        return transitions, gathered

    def _measurement(self, noise: Noise) -> Tensor:
        """(t, n, 3, 3) m^2, of the part of a measured position that is new in each sample."""
        way = noise.stamp_jitter * self.tracks.velocities
        white = torch.diag_embed((noise.position * self.tracks.white).square())
        return white + way[..., :, None] * way[..., None, :]

    def _filter(
        self, noise: Noise, transitions: Tensor, gathered: Tensor, measured: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, int]:
        """Means (t, n, w) and covariances after each sample; (t,) summed scores of next samples, and their number."""
        tracks, observe = self.tracks, self.measure
        prior = tracks.prior_variances(noise.spin_prior, noise.spin_label, noise.coefficients, self.velocity_prior)
        biases = noise.memory.square().expand(self.count, BIAS_DIM)
        covariance = torch.diag_embed(torch.cat((prior, biases), dim=1))
        mean = torch.cat((tracks.starts, torch.zeros((self.count, BIAS_DIM), dtype=torch.float64)), dim=1)
        unit = torch.eye(self.width, dtype=torch.float64)
        departures = torch.nn.functional.pad(tracks.departures, (0, BIAS_DIM))
        total, nexts = torch.zeros(self.count, dtype=torch.float64), 0
        means, covariances = [], []
        # taken apart once: the derivative of an index would fill a tensor of the whole size at every step
        steps, added, news = transitions.unbind(1), gathered.unbind(1), measured.unbind(1)
        for k in range(self.samples):
            if k:
                mean = (steps[k - 1] @ mean[..., None])[..., 0] + departures[:, k - 1]
                covariance = steps[k - 1] @ covariance @ steps[k - 1].mT + added[k - 1]
            spread = observe @ covariance @ observe.mT + news[k]
            root = torch.linalg.cholesky(spread)
            missed = tracks.errors[:, k] - mean @ observe.mT
            whitened = torch.linalg.solve_triangular(root, missed[..., None], upper=False)[..., 0]
            square = whitened.square().sum(dim=-1)
            if k >= NEXT_FROM:
                used = tracks.used[:, k]
                volume = torch.diagonal(root, dim1=-2, dim2=-1).log().sum(dim=-1)
                total = total + (_half_square(square, NEXT_TAIL) + volume) * used
                nexts += int(used.sum())
            gain = torch.cholesky_solve(observe @ covariance, root).mT
            gain = gain * (tracks.used[:, k] & (square < GATE))[:, None, None]
            mean = mean + (gain @ missed[..., None])[..., 0]
            rest = unit - gain @ observe
            covariance = rest @ covariance @ rest.mT + gain @ news[k] @ gain.mT
            means.append(mean)
            covariances.append(covariance)
        return torch.stack(means, dim=1), torch.stack(covariances, dim=1), total, nexts

    def _forecast(
        self, means: Tensor, covariances: Tensor, transitions: Tensor, gathered: Tensor, measured: Tensor
    ) -> tuple[Tensor, float, int]:
        """(t,) summed scores of forecasts, coordinates inside their 90 % intervals, and the number of forecasts."""
        track, start = self.starts.T
        mean, covariance = means[track, start], covariances[track, start]
        departures = torch.nn.functional.pad(self.tracks.departures, (0, BIAS_DIM))
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
            spread = self.measure @ covariance[scored] @ self.measure.mT + measured[at]
            variance = torch.diagonal(spread, dim1=-2, dim2=-1)
            square = (self.tracks.errors[at] - mean[scored] @ self.measure.mT).square() / variance
            scores = (_half_square(square, TAIL) + 0.5 * variance.log()).sum(dim=1)
            total = total.index_add(0, track[scored], scores)
            inside += float((square.detach() < NINETY**2).sum())
            count += len(scored)
        return total, inside, count


NINETY: Final = 1.6448536269514722
"""Standard deviations to each side of a central 90 % interval."""


def _half_square(square: Tensor, tail: float) -> Tensor:
    """Huber's loss of the root of a square: half of it, linear in the root beyond the tail."""
    return torch.where(square < tail**2, 0.5 * square, tail * square.clamp(min=1e-12).sqrt() - 0.5 * tail**2)
