"""Splits the squared error that predictions of linearised tracks are expected to have by the sources of the error.

The error of a prediction is a linear map of independent sources. With the gains of the filter held, its expected square
is linear in their variances. The gains minimise that square, so its derivative by a variance is the same whether the
gains are held or follow. The share of a source is its variance times that derivative, and the shares add up to the
whole (docs/derivations/budget.md).
"""

from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.arrays import Array, Mask
from ballfg.estimation.noise.linear_filter import BIAS_DIM, LinearFilter, Noise
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.factors.noise import PROCESS_NOISE
from ballfg.state import POSITION, SPIN, STATE_DIM

SOURCES: Final = ("observed", "spin", "coefficients", "tracker", "bounces", "motion", "samples")
"""White noise of the observed samples, with the wide priors of the first position and velocity; first spin;
coefficients; memory of the tracker and errors of stamps, of observed and predicted samples alike; impacts and hits;
motion between them; white noise of the predicted samples."""
IN_FLIGHT: Final = [PROCESS_NOISE.index(name) for name in ("acceleration", "spin")]


def squares_by_source(
    tracks: LinearTracks, noise: Noise, velocity_prior: float, observed: Mask, predicted: Mask
) -> Array:
    """Expected squared distances of predicted from measured positions, by source.

    A prediction is the ball's position, as `predict_tracks` makes it: the tracker's lasting error is not carried on.

    Args:
        tracks: t linearised tracks of n samples.
        noise: all of it, one row for all tracks.
        velocity_prior: m/s, standard deviation per axis at the start of a track.
        observed, predicted: (t, n) bool, samples that a prediction knows, and those it is compared with.
    Returns: (t, 7) m^2, summed over the predicted samples, in the order of `SOURCES`.
    Raises: numpy.linalg.LinAlgError: the covariance of an innovation is not positive definite.
    """
    lasting = bool((noise.memory > 0.0).any())
    known = replace(tracks, used=tracks.used & observed)
    linear = LinearFilter(known, velocity_prior, biased=lasting)
    white, measured = linear.white(noise), linear.measured(noise)
    stamps = measured.copy()
    for axis in range(3):
        stamps[..., axis, axis] -= white[..., axis]
    filtered = linear.run(noise, measured)
    given, covariances = filtered.variances, filtered.covariances
    by_covariances = np.zeros_like(covariances)
    for axis in range(3):
        by_covariances[..., axis, axis] = predicted
    by, _ = linear.slopes(filtered, by_states=(np.zeros_like(filtered.means), by_covariances))
    process, memory, prior = (getattr(given, n) * getattr(by, n) for n in ("process", "memory", "prior"))
    own, jitter = white * np.diagonal(by.measured, axis1=2, axis2=3), stamps * by.measured
    later = _trace(stamps) + given.memory.sum(axis=1)[:, None]
    if lasting:  # an error that lasts through the end of the observed part is in the prediction and in the sample
        bias = slice(linear.own, linear.own + BIAS_DIM)
        later = later + 2.0 * _trace(covariances[..., POSITION, bias])
    in_flight = process[:, IN_FLIGHT].sum(axis=1)
    return np.stack(
        [
            own.sum(axis=(1, 2)) + prior[:, : SPIN.start].sum(axis=1),
            prior[:, SPIN].sum(axis=1),
            prior[:, STATE_DIM:].sum(axis=1),
            jitter.sum(axis=(1, 2, 3)) + memory.sum(axis=1) + (later * predicted).sum(axis=1),
            process.sum(axis=1) - in_flight,
            in_flight,
            (white.sum(axis=-1) * predicted).sum(axis=1),
        ],
        axis=1,
    )


def _trace(matrices: Array) -> Array:
    """(...) of matrices (..., 3, 3)."""
    return np.trace(matrices, axis1=-2, axis2=-1)
