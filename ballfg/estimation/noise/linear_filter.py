"""Filters linearised tracks with any noise: state, coefficients and the tracker's biases together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index, plain
from ballfg.estimation.noise.filter_code import NEXT_FROM, filter_tracks
from ballfg.estimation.noise.filter_derivative import pull_back
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.estimation.settings import LEAST_NOISE
from ballfg.parallel.parts import in_threads, jobs_here

BIAS_DIM: Final = 3


@dataclass(frozen=True)
class Noise:
    """All noise, or derivatives by it: a row for each track, r = t, or one row for all, r = 1.

    Attributes:
        position: (r, 3) multiples of the white standard deviations of the samples.
        memory: (r, 3) m^2, variances.  memory_time: (r,) s.  stamp_jitter: (r,) s^2, variance.
        process: (r, 7) the numbers of `PROCESS_NOISE`.
        spin_label, spin_prior: (r,) rad/s.
        coefficients: (r, p) multiples of their prior standard deviations; (r, 1) one for all.
    """

    position: Array
    memory: Array
    memory_time: Array
    stamp_jitter: Array
    process: Array
    spin_label: Array
    spin_prior: Array
    coefficients: Array


@dataclass(frozen=True)
class Variances:
    """The variances of all sources of error of t tracks of n samples, or derivatives by them.

    Attributes:
        process: (t, 7) squares of the numbers of `PROCESS_NOISE`.
        memory: (t, 3) m^2.
        prior: (t, d) of the first state and the coefficients, in the squares of their units.
        measured: (t, n, 3, 3) m^2, of the white error of a measured position.
    """

    process: Array
    memory: Array
    prior: Array
    measured: Array


@dataclass(frozen=True)
class Filtered:
    """The filter's results for t tracks of n samples.

    Attributes:
        means: (t, n, w) after each sample.
        covariances: (t, n, w, w).
        nll: (t,) summed negative logarithms of the density of each next sample.
        count: number of these samples.
        variances: of the sources.  decays: (t, n - 1) of the memory.
        steps: further results of machine code, which the derivatives need.
    """

    means: Array
    covariances: Array
    nll: Array
    count: int
    variances: Variances
    decays: Array
    steps: tuple[Array, ...]


def _of_tracks(code: Callable[..., bool], *arrays: Array | Index) -> list[bool]:
    """What machine code returns for parts of all tracks (t, ...), each on a thread: tracks do not depend on others."""
    ends = np.unique(np.linspace(0, len(arrays[0]), jobs_here() + 1).round().astype(int)).tolist()
    return list(in_threads(lambda part: code(*(one[slice(*part)] for one in arrays)), pairwise(ends)))


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
        self.first = np.pad(tracks.starts, ((0, 0), (0, self.biases)))
        self.seen = tracks.used.astype(np.int64)
        self._scored = int(tracks.used[:, NEXT_FROM:].sum())

    def measured(self, noise: Noise) -> Array:
        """(t, n, 3, 3) m^2, covariance of the white error of a measured position."""
        way, white = self.tracks.velocities, self.white(noise)
        found = noise.stamp_jitter[:, None, None, None] * way[..., :, None] * way[..., None, :]
        for axis in range(3):
            found[..., axis, axis] += white[..., axis]
        return np.asarray(found)

    def white(self, noise: Noise) -> Array:
        """(t, n, 3) m^2, variances of the samples' white errors without those of the stamps."""
        return np.asarray(
            np.maximum(noise.position[:, None, :] * self.tracks.white, LEAST_NOISE) ** 2
        )  # some have none

    def losses(self, noise: Noise) -> tuple[Array, Noise]:
        """(t,) negative logarithms of the marginal likelihood of each track, and their derivatives by the noise."""
        filtered = self.run(noise, self.measured(noise))
        return filtered.nll, self.noise_slopes(noise, filtered, *self.slopes(filtered, 1.0))

    def run(self, noise: Noise, measured: Array) -> Filtered:
        """The filter over all samples.

        Args:
            noise: all of it.
            measured: (t, n, 3, 3) m^2, the result of `measured`.
        Raises: numpy.linalg.LinAlgError: the covariance of an innovation is not positive definite.
        """
        tracks, shape, width = self.tracks, (self.count, self.samples), self.width
        known = tracks.prior_variances(noise.spin_prior, noise.spin_label, noise.coefficients, self.velocity_prior)
        process, memory = (np.tile(x, (self.count // len(x), 1)) for x in (noise.process**2, noise.memory))
        decays = np.exp(-np.diff(tracks.times, axis=1) / noise.memory_time[:, None])
        prior = np.concatenate((known, memory[:, : self.biases]), axis=1)
        sizes = (width,), (width, width), (width, 3), (3, 3), (3,), ()
        made, nll = [np.empty(shape + size) for size in sizes], np.empty(self.count)
        moved = tracks.transitions, tracks.offsets, tracks.kicks
        given = plain(process), decays, plain(memory), plain(measured)
        if not all(_of_tracks(filter_tracks, *moved, *given, tracks.errors, self.seen, self.first, prior, *made, nll)):
            raise np.linalg.LinAlgError("the covariance of an innovation is not positive definite")
        variances = Variances(process, memory, known, measured)
        return Filtered(made[0], made[1], nll, self._scored, variances, decays, tuple(made[2:]))

    def slopes(
        self, filtered: Filtered, by_nll: Array | float = 0.0, by_states: tuple[Array, Array] | None = None
    ) -> tuple[Variances, Array]:
        """Derivatives of a function of the results by the variances, and (t, n - 1) by the decays of the memory.

        Args:
            filtered: the results.  by_nll: (t,) derivatives of the function by the densities, or one for all.
            by_states: derivatives by means (t, n, w) and covariances (t, n, w, w); None if it depends on none.
        """
        tracks, (count, samples, width) = self.tracks, filtered.means.shape
        if by_states is None:
            by_states = np.empty((count, 0, width)), np.empty((count, 0, width, width))
        sizes = (tracks.kicks.shape[2],), (samples - 1,), (BIAS_DIM,), (width,), (samples, 3, 3)
        process, decays, memory, prior, measured = found = [np.empty((count, *size)) for size in sizes]
        moved = tracks.transitions, tracks.kicks, filtered.decays, plain(filtered.variances.memory), self.seen
        results = filtered.means, filtered.covariances, *filtered.steps
        _of_tracks(pull_back, *moved, *results, *by_states, np.full(count, by_nll, dtype=np.float64), *found)
        memory[:, : self.biases] += prior[:, self.own :]
        return Variances(process, memory, prior[:, : self.own], measured), decays

    def noise_slopes(self, noise: Noise, filtered: Filtered, by: Variances, by_decays: Array) -> Noise:
        """Derivatives (t, ...) by the noise from those by the variances and decays, one row for each track."""
        tracks, way, step = self.tracks, self.tracks.velocities, np.diff(self.tracks.times, axis=1)
        size = noise.position[:, None, :] * tracks.white
        by_white = np.where(size >= LEAST_NOISE, 2.0 * size * np.diagonal(by.measured, axis1=2, axis2=3), 0.0)
        spin, label, coefficients = tracks.prior_slopes(
            noise.spin_prior, noise.spin_label, noise.coefficients, by.prior
        )
        return Noise(
            position=(by_white * tracks.white).sum(axis=1),
            memory=by.memory,
            memory_time=(by_decays * filtered.decays * step).sum(axis=1) / noise.memory_time**2,
            stamp_jitter=np.einsum("tni,tnij,tnj->t", way, by.measured, way, optimize=True),
            process=2.0 * noise.process * by.process,
            spin_label=label,
            spin_prior=spin,
            coefficients=coefficients,
        )
