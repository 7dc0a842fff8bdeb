"""Covariances of all states from the Bayes net that the elimination leaves behind.

Backwards along the track: p(x_i | x_{i+1}, c) is Gaussian with square-root information R_i and coupling S_i, so that
with y = (x_{i+1}, c) and K_i = -R_i^-1 S_i the joint covariance follows from that of y. Nothing is inverted but the
triangular R_i; GTSAM's `Marginals` would go through Cholesky, which a loose prior beside a tight process noise defeats.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from ballfg.factors.batch import Array
from ballfg.state import STATE_DIM


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances at the minimum.

    Attributes:
        states: (n, 9, 9).
        coefficients: (p, p).
        cross: (n, 9, p) between each state and the coefficients.
    """

    states: Array
    coefficients: Array
    cross: Array


def marginal_covariances(bayes_net: gtsam.GaussianBayesNet, n: int, p: int) -> Covariances:
    """Covariances from a net over states 0..n-1 in order, then p coefficients (none if p is 0)."""
    size = STATE_DIM + p
    states, cross = np.empty((n, STATE_DIM, STATE_DIM)), np.empty((n, STATE_DIM, p))
    coefficients = _inverse_gram(bayes_net.at(n).R()) if p else np.zeros((0, 0))
    later = np.zeros((size, size))  # joint covariance of (x_{i+1}, c)
    later[STATE_DIM:, STATE_DIM:] = coefficients
    for i in range(n - 1, -1, -1):
        conditional = bayes_net.at(i)
        inverse = np.linalg.inv(conditional.R())
        gain = np.zeros((STATE_DIM, size))
        coupling, column = -inverse @ conditional.S(), 0
        for key in conditional.keys()[1:]:
            target = slice(STATE_DIM, size) if key == n else slice(0, STATE_DIM)
            width = p if key == n else STATE_DIM
            gain[:, target] = coupling[:, column : column + width]
            column += width
        with_later = gain @ later
        states[i] = inverse @ inverse.T + with_later @ gain.T
        cross[i] = with_later[:, STATE_DIM:]
        later[:STATE_DIM, :STATE_DIM] = states[i]
        later[:STATE_DIM, STATE_DIM:] = cross[i]
        later[STATE_DIM:, :STATE_DIM] = cross[i].T
    return Covariances(states, coefficients, cross)


def _inverse_gram(root: Array) -> Array:
    inverse = np.linalg.inv(root)
    return np.asarray(inverse @ inverse.T)
