"""A Kalman filter over linearised tracks, for any noise: state, coefficients and the tracker's biases together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.estimation.settings import LEAST_NOISE
from ballfg.state import POSITION, STATE_DIM

BIAS_DIM: Final = 3
NEXT_FROM: Final = 3
"""Samples that determine a state; the marginal likelihood counts those after them."""
GATE: Final = 30.0
"""Squared whitened innovation of three coordinates; beyond it, one in a million, a sample does not update."""
NEXT_TAIL: Final = 4.0
"""Standard deviations, of the norm of three coordinates, beyond which the score of a next sample grows linearly; a
missed hit must not decide the noise."""


@dataclass(frozen=True)
class Noise:
    """All noise as tensors, differentiable: a row for each track, r = t, or one row for all, r = 1.

    Attributes:
        position: (r, 3) multiples of the white standard deviations of the samples.
        memory: (r, 3) m^2, variances.  memory_time: (r,) s.  stamp_jitter: (r,) s^2, variance.
        process: (r, 7) the numbers of `PROCESS_NOISE`.
        spin_label, spin_prior: (r,) rad/s.
        coefficients: (r,) multiple of their prior standard deviations.
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
class Filtered:
    """What the filter makes of t tracks of n samples.

    Attributes:
        means: (t, n, w) after each sample.
        covariances: (t, n, w, w).
        following: (t,) summed negative logarithms of the density of each next sample.
        count: number of these samples.
    """

    means: Tensor
    covariances: Tensor
    following: Tensor
    count: int


class LinearFilter:
    """Filters some linearised tracks with any noise.

    Args:
        tracks: linearised.
        velocity_prior: m/s, standard deviation per axis at the start of a track.
        biased: whether the noise may have a memory; three numbers of the state, and time, are spared if not.
    """

    def __init__(self, tracks: LinearTracks, velocity_prior: float, *, biased: bool = True) -> None:
        self.tracks, self.velocity_prior = tracks, velocity_prior
        self.count, self.samples = tracks.times.shape
        self.own = tracks.transitions.shape[-1]
        self.biases = BIAS_DIM if biased else 0
        self.width = self.own + self.biases
        self.measure = torch.zeros((3, self.width), dtype=torch.float64)
        self.measure[:, POSITION] = torch.eye(3, dtype=torch.float64)
        self.measure[:, self.own :] = torch.eye(3, dtype=torch.float64)[:, : self.biases]

    def motion(self, noise: Noise) -> tuple[Tensor, Tensor]:
        """(t, n - 1, w, w) transitions and covariances gathered, of state, coefficients and biases."""
        shape = (self.count, self.samples - 1, self.width, self.width)
        transitions, gathered = (torch.zeros(shape, dtype=torch.float64) for _ in range(2))
        transitions[..., : self.own, : self.own] = self.tracks.transitions
        process = noise.process.square().expand(self.count, -1)
        gathered[..., :STATE_DIM, :STATE_DIM] = torch.einsum("tk,tnkij->tnij", process, self.tracks.kicks)
        if self.biases:
            decay = torch.exp(-torch.diff(self.tracks.times, dim=1) / noise.memory_time[:, None])
            axes = torch.arange(self.own, self.width)
            transitions[..., axes, axes] = decay[..., None]
            gathered[..., axes, axes] = noise.memory[:, None, :] * (1.0 - decay.square())[..., None]
        return transitions, gathered

    def measured(self, noise: Noise) -> Tensor:
        """(t, n, 3, 3) m^2, of the part of a measured position that is new in each sample."""
        way = self.tracks.velocities
        along = noise.stamp_jitter[:, None, None, None] * way[..., :, None] * way[..., None, :]
        white = (noise.position[:, None, :] * self.tracks.white).clamp_min(LEAST_NOISE)  # an axis may show none
        return along + torch.diag_embed(white.square())

    def losses(self, noise: Noise) -> Tensor:
        """(t,) negative logarithms of the marginal likelihood of each track."""
        return self.run(noise, *self.motion(noise), self.measured(noise)).following

    def run(self, noise: Noise, transitions: Tensor, gathered: Tensor, measured: Tensor) -> Filtered:
        """The filter over all samples, with what `motion` and `measured` make of the noise."""
        tracks, observe = self.tracks, self.measure
        prior = tracks.prior_variances(noise.spin_prior, noise.spin_label, noise.coefficients, self.velocity_prior)
        covariance = torch.diag_embed(torch.cat((prior, noise.memory.expand(self.count, -1)[:, : self.biases]), dim=1))
        mean = torch.cat((tracks.starts, torch.zeros((self.count, self.biases), dtype=torch.float64)), dim=1)
        departures = torch.nn.functional.pad(tracks.departures, (0, self.biases))
        means, covariances, squares, volumes = [], [], [], []
        # taken apart once: the derivative of an index would fill a tensor of the whole size at every step
        steps, added, news = transitions.unbind(1), gathered.unbind(1), measured.unbind(1)
        for k in range(self.samples):
            if k:
                mean = (steps[k - 1] @ mean[..., None])[..., 0] + departures[:, k - 1]
                covariance = torch.baddbmm(added[k - 1], steps[k - 1] @ covariance, steps[k - 1].mT)
            seen = observe @ covariance
            root = torch.linalg.cholesky(seen @ observe.mT + news[k])
            missed = tracks.errors[:, k] - mean @ observe.mT
            # of the innovation and of what it tells, the columns per whitened innovation
            whitened = torch.linalg.solve_triangular(root, torch.cat((missed[..., None], seen), dim=2), upper=False)
            innovation, told = whitened[..., :1], whitened[..., 1:]
            square = innovation.square().sum(dim=(1, 2))
            squares.append(square)
            volumes.append(torch.diagonal(root, dim1=-2, dim2=-1))
            told = told * (tracks.used[:, k] & (square < GATE))[:, None, None]
            mean = mean + (told.mT @ innovation)[..., 0]
            if k:
                covariance = torch.baddbmm(covariance, told.mT, told, alpha=-1.0)
            else:  # a difference would lose ten digits: the prior of the position is that much wider than what is left
                gain = torch.linalg.solve_triangular(root.mT, told, upper=True).mT
                rest = torch.eye(self.width, dtype=torch.float64) - gain @ observe
                covariance = rest @ covariance @ rest.mT + gain @ news[k] @ gain.mT
            means.append(mean)
            covariances.append(covariance)
        used = tracks.used[:, NEXT_FROM:]
        volume = torch.stack(volumes[NEXT_FROM:], dim=1).log().sum(dim=-1)
        following = (half_square(torch.stack(squares[NEXT_FROM:], dim=1), NEXT_TAIL) + volume) * used
        return Filtered(
            torch.stack(means, dim=1), torch.stack(covariances, dim=1), following.sum(dim=1), int(used.sum())
        )


def half_square(square: Tensor, tail: float) -> Tensor:
    """Huber's loss of the root of a square: half of it, linear in the root beyond the tail."""
    return torch.where(square < tail**2, 0.5 * square, tail * square.clamp(min=1e-12).sqrt() - 0.5 * tail**2)
