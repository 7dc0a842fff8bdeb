"""Filters linearised tracks with any noise: state, coefficients and the tracker's biases together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ballfg.deferred import torch
from ballfg.estimation.noise.filter_code import NEXT_FROM
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.estimation.settings import LEAST_NOISE

if TYPE_CHECKING:
    from torch import Tensor

BIAS_DIM: Final = 3


@dataclass(frozen=True)
class Noise:
    """All noise as tensors, differentiable: a row for each track, r = t, or one row for all, r = 1.

    Attributes:
        position: (r, 3) multiples of the white standard deviations of the samples.
        memory: (r, 3) m^2, variances.  memory_time: (r,) s.  stamp_jitter: (r,) s^2, variance.
        process: (r, 7) the numbers of `PROCESS_NOISE`.
        spin_label, spin_prior: (r,) rad/s.
        coefficients: (r, p) multiples of their prior standard deviations; (r, 1) one for all.
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
class Variances:
    """The variances of all sources of error of t tracks of n samples.

    Attributes:
        process: (t, 7) squares of the numbers of `PROCESS_NOISE`.
        memory: (t, 3) m^2.
        prior: (t, d) of the first state and the coefficients, in the squares of their units.
        measured: (t, n, 3, 3) m^2, of the white error of a measured position.
    """

    process: Tensor
    memory: Tensor
    prior: Tensor
    measured: Tensor


@dataclass(frozen=True)
class Filtered:
    """The filter's results for t tracks of n samples.

    Attributes:
        means: (t, n, w) after each sample.
        covariances: (t, n, w, w).
        nll: (t,) summed negative logarithms of the density of each next sample.
        count: number of these samples.
    """

    means: Tensor
    covariances: Tensor
    nll: Tensor
    count: int


class LinearFilter:
    """Filters some linearised tracks with any noise.

    Args:
        tracks: linearised.
        velocity_prior: m/s, standard deviation per axis at the start of a track.
        biased: True if the noise may have a memory; False saves three numbers of the state, and time.

    Attributes: first: (t, w) first errors and biases.  seen: (t, n) 1 for the samples that it takes in.
    """

    def __init__(self, tracks: LinearTracks, velocity_prior: float, *, biased: bool = True) -> None:
        self.tracks, self.velocity_prior = tracks, velocity_prior
        self.count, self.samples = tracks.times.shape
        self.own = tracks.transitions.shape[-1]
        self.biases = BIAS_DIM if biased else 0
        self.width = self.own + self.biases
        self.first = torch.nn.functional.pad(tracks.starts, (0, self.biases)).contiguous().numpy()
        self.seen = tracks.used.to(torch.int64).numpy()
        self._scored = int(tracks.used[:, NEXT_FROM:].sum())

    def measured(self, noise: Noise) -> Tensor:
        """(t, n, 3, 3) m^2, covariance of the white error of a measured position."""
        way = self.tracks.velocities
        along = noise.stamp_jitter[:, None, None, None] * way[..., :, None] * way[..., None, :]
        return along + torch.diag_embed(self.white(noise))

    def white(self, noise: Noise) -> Tensor:
        """(t, n, 3) m^2, variances of the samples' white errors without those of the stamps."""
        white = noise.position[:, None, :] * self.tracks.white
        return white.clamp_min(LEAST_NOISE).square()  # an axis may have no noise

    def losses(self, noise: Noise) -> Tensor:
        """(t,) negative logarithms of the marginal likelihood of each track."""
        return self.run(noise, self.measured(noise)).nll

    def run(self, noise: Noise, measured: Tensor) -> Filtered:
        """The filter over all samples, differentiable by the noise.

        Args:
            noise: all of it.
            measured: (t, n, 3, 3) m^2, the result of `measured`.
        Raises: torch.linalg.LinAlgError: the covariance of an innovation is not positive definite.
        """
        return self.run_with(self.variances(noise, measured), noise.memory_time)

    def variances(self, noise: Noise, measured: Tensor) -> Variances:
        """The variances of all sources of error under some noise; arguments as those of `run`."""
        tracks, count = self.tracks, self.count
        prior = tracks.prior_variances(noise.spin_prior, noise.spin_label, noise.coefficients, self.velocity_prior)
        return Variances(noise.process.square().expand(count, -1), noise.memory.expand(count, -1), prior, measured)

    def run_with(self, variances: Variances, memory_time: Tensor) -> Filtered:
        """The filter for the variances of all sources of error, differentiable by them.

        Args: variances: of all sources.  memory_time: (r,) s.
        Raises: torch.linalg.LinAlgError: as `run`.
        """
        decays = torch.exp(-torch.diff(self.tracks.times, dim=1) / memory_time[:, None])
        memory = variances.memory
        prior = torch.cat((variances.prior, memory[:, : self.biases]), dim=1)
        from ballfg.estimation.noise.differentiable_filter import FilterRun

        means, covariances, nll = FilterRun.apply(self, variances.process, decays, memory, prior, variances.measured)
        return Filtered(means, covariances, nll, self._scored)
