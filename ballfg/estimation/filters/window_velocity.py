"""Fits velocities to windows of a few samples, as a start for estimates and for the direction of a launch."""

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array
from ballfg.state import STANDARD_GRAVITY, Z
from ballfg.tracks.track import FASTEST_BALL

WINDOW = 5  # Samples in a window


def window_velocities(times: Array, positions: Array, breaks: ArrayLike = ()) -> Array:
    """Velocities at all samples, by line fits over five samples that end at the breaks of the motion.

    Least squares over p(t) = p_0 + v t - g t^2/2 e_z, with t counted from the sample, so that v is the velocity there.
    A window is centred on its sample, shifted near a break or an end of the track, and shorter if two breaks hold fewer
    than five samples. A sample alone between breaks gets the mean slope to its neighbours.

    Args:
        times: (n,) s, increasing.  positions: (n, 3) m.
        breaks: intervals (between samples i and i+1) in which a contact or a hit broke the motion.
    Returns: (n, 3) m/s, always finite, at most `FASTEST_BALL`; zero for a track of one sample.
    """
    n = len(times)
    if n == 1:
        return np.zeros((1, 3))
    at, cuts = np.arange(n), np.asarray(breaks, dtype=np.int64) + 1
    first, stop = np.zeros(n + 1, dtype=np.int64), np.full(n + 1, n)
    first[cuts] = stop[cuts] = cuts
    begin, end = np.maximum.accumulate(first[:-1]), np.minimum.accumulate(stop[:0:-1])[::-1]
    low = np.maximum(np.minimum(at - WINDOW // 2, end - WINDOW), begin)
    window = low[:, None] + np.arange(WINDOW)
    weight = (window < end[:, None]).astype(np.float64)  # (n, 5)
    window = np.minimum(window, n - 1)
    t = times[window] - times[:, None]
    p = positions[window]  # (n, 5, 3)
    p[:, :, Z] += 0.5 * STANDARD_GRAVITY * t**2
    count = weight.sum(axis=-1, keepdims=True)
    centred = weight * (t - (weight * t).sum(axis=-1, keepdims=True) / count)
    scatter = (centred * t).sum(axis=-1)
    alone = count[:, 0] == 1
    velocities = np.einsum("nk,nkd->nd", centred, p) / np.where(alone, 1.0, scatter)[:, None]
    if alone.any():
        slopes = np.diff(positions, axis=0) / np.diff(times)[:, None]
        padded = np.concatenate((slopes[:1], slopes, slopes[-1:]))
        velocities[alone] = ((padded[1:] + padded[:-1]) / 2)[alone]
    speed = np.linalg.norm(velocities, axis=1, keepdims=True)
    return np.asarray(velocities * (FASTEST_BALL / np.maximum(speed, FASTEST_BALL)))
