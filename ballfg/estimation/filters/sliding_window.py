"""The sliding-window mean is the simplest estimate of a velocity and a start for the better ones.

Source: Q. Xiao, Z. Wu, M. Gombolay, "Learning Dynamics of a Ball with Differentiable Factor Graph and
Roto-Translational Invariant Representations", section IV: the average velocity within a sliding window of size 5.
"""

from collections.abc import Sequence
from functools import partial
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.flight_step import rate_jacobian
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.filters.window_velocity import WINDOW, window_velocities
from ballfg.estimation.plausible import plausible
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import sample_sigmas, spin_start, total_sigmas
from ballfg.factors.batch import FactorBatch
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, STATE_DIM, VELOCITY, Z
from ballfg.tracks import Track

START_SEARCH = 12  # Number of samples among which the first good ones of a flight are searched
START_GATE = 30.7
"""Squared whitened miss beyond which three samples are not one flight: chi-square, 3 degrees of freedom, 1e-6."""
START_ACCELERATION = 20.0
"""m/s^2, standard deviation of the acceleration of three samples beside gravity: twice a fast ball's drag."""
FRICTION_SHARE = 0.5
"""Largest change of tangential speed in a bounce, as a share of the normal speed's change: Coulomb's mu."""
UNUSED = "observations beside positions are not used"


class SlidingWindow(Estimator):
    """The mean velocity over a causal window of five samples; a baseline without corrections.

    - Position: as measured, with the standard deviation of the whole error: white, lasting, and that of the stamp.
      Velocity: (p_k - p_j) / (t_k - t_j) with j = max(k - 4, 0); at the first sample, zero with the prior's covariance.
      Spin: the label, or zero.
    - The mean velocity is that of the window's middle, so it lags by half a window times the acceleration. The
      covariance is the matrix of mean squared errors: measurement noise (and its correlation with the position),
      plus the outer product of the lag that the model gives, plus the part of it that an unknown spin makes.
    - The window does average over a bounce. Where it may hold one - the ball was within one interval's travel of a
      surface - the variance gets a third of the squared jump (the mean square over a bounce anywhere in the window),
      and from there on the spin's variance that of an unlabelled spin as well.
    - It has no innovations, and finds neither contacts, hits nor outliers: its quality is empty.
    """

    name = "sliding-window"

    def estimate(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Estimate:
        """The states of a track, from its positions alone; the status reports a single sample, without velocity."""
        written = self.prepared(track, factors)
        track = written.since_first()
        n, settings = len(track), self.settings.for_track(track)
        white = sample_sigmas(settings, n, track.sigmas)
        sigma = total_sigmas(settings, white, partial(window_velocities, track.times, track.positions))
        first = np.maximum(np.arange(n) - WINDOW + 1, 0)
        span = track.times - track.times[first]
        span[0] = 1.0  # the first sample's difference is zero; its velocity is the prior's
        states = np.zeros((n, STATE_DIM))
        states[:, POSITION] = track.positions
        states[:, VELOCITY] = (track.positions - track.positions[first]) / span[:, None]
        states[:, SPIN] = spin_start(self.settings.spin_label(track), self.settings).spin
        bounced = may_touch(track.times, track.positions, self.surfaces, self.model.radius)
        covariances = _measurement_covariance(sigma, first, span)
        covariances[:, SPIN, SPIN] = self._spin_covariance(track, bounced)
        covariances[:, VELOCITY, VELOCITY] += _lag_covariance(self.model, states, covariances[:, SPIN, SPIN], span)
        covariances[:, VELOCITY, VELOCITY] += _bounce_covariance(track, first, bounced)
        covariances[0, VELOCITY] = covariances[0, :, VELOCITY] = 0.0
        covariances[0, VELOCITY, VELOCITY] = self.settings.velocity_prior**2 * np.eye(3)
        estimate = Estimate(
            name=track.name,
            times=track.times,
            states=states,
            covariances=covariances,
            status=Status.OK if n > 1 else Status.NO_VELOCITY,
            innovations={"position": np.full((n, 3), np.nan)},
            world=self.world,
            notes=self.doubts(track) + (UNUSED,) * any(not one.locates for one in track.observations),
            cross_covariances=np.zeros((n, STATE_DIM, 0)),
        )
        return plausible(estimate, track, sigma, self.settings).dated(written.times)

    def _spin_covariance(self, track: Track, bounced: NDArray[np.bool_]) -> Array:
        """(n, 3, 3): prior or label, the random walk since, and an unknown change after a possible bounce."""
        start = spin_start(self.settings.spin_label(track), self.settings).covariance
        walk = self.settings.process.spin**2 * (track.times - track.times[0])
        bounce = self.settings.spin_prior**2 * np.logical_or.accumulate(bounced)
        return np.asarray(start + walk[:, None, None] * np.eye(3) + bounce[:, None, None] * np.eye(3))


def may_touch(times: Array, positions: Array, surfaces: Surfaces, radius: float) -> NDArray[np.bool_]:
    """(n,) True if one of the last two samples is nearer to a surface than the ball moves in one interval."""
    n = len(times)
    gap = np.abs(positions[:, Z, None] - radius - np.array(surfaces.heights())).min(axis=-1, initial=np.inf)
    travel = np.abs(np.diff(positions[:, Z]))
    reach = np.zeros(n)  # the vertical travel of the neighbouring intervals: the one with the bounce hides it
    reach[1:] = travel
    reach[2:] = np.maximum(reach[2:], travel[:-1])
    reach[1:-1] = np.maximum(reach[1:-1], travel[1:])
    touching = np.zeros(n, dtype=bool)
    touching[1:] = np.minimum(gap[1:], gap[:-1]) < reach[1:]
    return touching


def _measurement_covariance(sigma: Array, first: NDArray[np.int64], span: Array) -> Array:
    """(n, 9, 9) of position p_k and velocity (p_k - p_j) / span, from the noise of p_k and p_j."""
    covariance = np.zeros((len(sigma), STATE_DIM, STATE_DIM))
    at, axes = sigma**2, np.arange(3)
    covariance[:, axes, axes] = at
    covariance[:, axes, 3 + axes] = covariance[:, 3 + axes, axes] = at / span[:, None]
    covariance[:, 3 + axes, 3 + axes] = (at + at[first]) / span[:, None] ** 2
    return covariance


def _lag_covariance(model: BallModel, states: Array, spin_covariance: Array, span: Array) -> Array:
    """(n, 3, 3): mean squared error of a velocity that is half a window old, by the model's acceleration."""
    state = torch.from_numpy(states)
    with torch.no_grad():
        acceleration = model.rates(state)[0].numpy()
    by_spin = rate_jacobian(model.rates, state)[:, VELOCITY, SPIN].numpy()
    half = span[:, None, None] / 2
    lag, by_spin = acceleration[:, :, None] * half, by_spin * half
    return np.asarray(lag @ lag.swapaxes(-1, -2) + by_spin @ spin_covariance @ by_spin.swapaxes(-1, -2))


def _bounce_covariance(track: Track, first: NDArray[np.int64], bounced: NDArray[np.bool_]) -> Array:
    """(n, 3, 3): a third of the squared jump of velocity where the window of samples first_k..k may hold a bounce."""
    n = len(track)
    fall = np.zeros(n)
    fall[1:] = np.abs(np.diff(track.positions[:, Z]) / np.diff(track.times))
    window = np.maximum(np.arange(n)[:, None] - np.arange(WINDOW - 1), first[:, None] + 1)
    window = np.minimum(window, n - 1)
    held = bounced[window].any(axis=-1)
    jump = 2.0 * fall[window].max(axis=-1) * held
    shares = np.array([FRICTION_SHARE, FRICTION_SHARE, 1.0])
    return np.asarray((jump[:, None, None] * np.diag(shares)) ** 2 / 3.0)


def first_pair(
    times: Array, positions: Array, sigma: Array, near: NDArray[np.bool_], first: int = 0
) -> tuple[int, int]:
    """The first two good samples of a flight from sample `first` on: with a third they lie on a parabola.

    The triple with the best parabola among those that end earliest gives them. Samples near a surface agree with all,
    as a bounce may lie between them. If nothing fits, they are `first` and the next one.

    Args: times: (n,) s.  positions, sigma: (n, 3) m.  near: (n,) bool, samples near a surface.
    """
    for last in range(first + 2, min(first + START_SEARCH, len(times))):
        pairs = list(combinations(range(first, last), 2))
        triples = ([i, j, last] for i, j in pairs)
        misses = [0.0 if near[t].any() else _parabola_miss(times[t], positions[t], sigma[t]) for t in triples]
        if min(misses) < START_GATE:
            return pairs[int(np.argmin(misses))]
    return first, first + 1


def _parabola_miss(times: Array, positions: Array, sigma: Array) -> float:
    """Squared whitened distance of the second of three samples from a flight between the others, drag unknown."""
    since, until = np.diff(times)
    span = times[2] - times[0]
    shares, bend = np.array([until / span, -1.0, since / span]), 0.5 * since * until
    miss = shares @ positions
    miss[Z] += bend * STANDARD_GRAVITY
    variance = shares**2 @ sigma**2 + (bend * START_ACCELERATION) ** 2
    return float((miss**2 / variance).sum())
