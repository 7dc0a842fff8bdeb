"""Posterior covariances of neighbouring states and of the coefficients, of many tracks at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ballfg.factors.batch import COEFFICIENTS, Array, Index
from ballfg.learning.gradient.conjugate_gradients import GaussNewtonFactors
from ballfg.state import STATE_DIM


@dataclass(frozen=True)
class Posterior:
    """Covariances of t tracks with up to n states and p coefficients each.

    Attributes:
        states: (t, n, 9, 9).
        cross: (t, n, 9, 9 + p), of each state with the next one and with the coefficients.
        coefficients: (t, p, p).
    """

    states: Array
    cross: Array
    coefficients: Array

    def joint(self, track: int, left: Index, right: Index) -> Array:
        """(m, d, e) covariances of variables of one track, each pair the same, neighbours, or with the coefficients.

        Args: left: (m,) variable numbers.  right: (m,).
        """
        if left[0] == COEFFICIENTS or right[0] == COEFFICIENTS:
            if left[0] == right[0]:
                return np.broadcast_to(self.coefficients[track], (len(left), *self.coefficients.shape[1:]))
            if left[0] == COEFFICIENTS:
                return self.joint(track, right, left).swapaxes(-1, -2)
            return self.cross[track, left][:, :, STATE_DIM:]
        if (left == right).all():
            return self.states[track, left]
        if left[0] > right[0]:
            return self.joint(track, right, left).swapaxes(-1, -2)
        return self.cross[track, left][:, :, :STATE_DIM]


def posterior_of(factors: GaussNewtonFactors) -> Posterior:
    """The covariances (R^T R)^-1, by the recursion from the last state back to the first."""
    inverse, following, shared, last = factors.inverse, factors.following, factors.shared, factors.last
    tracks, n, p = inverse.shape[0], inverse.shape[1], shared.shape[-1]
    states, cross = np.empty((tracks, n, STATE_DIM, STATE_DIM)), np.empty((tracks, n, STATE_DIM, STATE_DIM + p))
    coefficients = last @ last.mT
    later = np.zeros((tracks, STATE_DIM + p, STATE_DIM + p))  # joint covariance of (x_{i+1}, c)
    later[:, STATE_DIM:, STATE_DIM:] = coefficients
    for i in range(n - 1, -1, -1):
        gain = -inverse[:, i] @ np.concatenate((following[:, i], shared[:, i]), axis=-1)
        cross[:, i] = gain @ later
        states[:, i] = inverse[:, i] @ inverse[:, i].mT + cross[:, i] @ gain.mT
        later[:, :STATE_DIM, :STATE_DIM] = states[:, i]
        own = cross[:, i, :, STATE_DIM:]
        later[:, :STATE_DIM, STATE_DIM:], later[:, STATE_DIM:, :STATE_DIM] = own, own.mT
    return Posterior(states, cross, coefficients)
