"""Computes covariances of states and coefficients from the triangles of eliminations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.factors.batch import COEFFICIENTS
from ballfg.factors.linear.definite import definite, variances_positive
from ballfg.factors.linear.elimination import Root
from ballfg.factors.linear.substitution import covariances_of


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances at the minimum.

    Attributes:
        states: (n, 9 + b, 9 + b) of states and biases, in the products of m, m/s and rad/s.
        coefficients: (p, p) in the products of their own units.
        cross: (n, 9 + b, p) between each of them and the coefficients, in the products of their units.
    """

    states: Array
    coefficients: Array
    cross: Array

    def definite(self) -> "Covariances | None":
        """The same, safe from rounding; None if a track leaves an unknown undetermined in double precision."""
        if not variances_positive(self.states).all() or not np.isfinite(self.cross).all():
            return None
        return replace(self, states=definite(self.states))

    def joint(self, state: int) -> Array:
        """(9 + b + p, 9 + b + p) of a state and its bias with the coefficients behind them."""
        own, cross = self.states[state], self.cross[state]
        w, size = len(own), len(own) + len(self.coefficients)
        joint = np.empty((size, size))
        joint[:w, :w], joint[:w, w:], joint[w:, :w], joint[w:, w:] = own, cross, cross.T, self.coefficients
        return joint


@dataclass(frozen=True)
class NeighbourCovariances:
    """Covariances of t tracks with up to n states of w numbers (biases among them) and p coefficients each.

    Attributes:
        states: (t, n, w, w).
        cross: (t, n, w, w + p), of each state with the next one and the coefficients.
        coefficients: (t, p, p).
    """

    states: Array
    cross: Array
    coefficients: Array

    def joint(self, track: int, left: Index, right: Index) -> Array:
        """(m, d, e) covariances of pairs of one track's variables: equal, neighbours, or with the coefficients.

        Args: left: (m,) variable numbers.  right: (m,).
        """
        if left[0] == COEFFICIENTS or right[0] == COEFFICIENTS:
            if left[0] == right[0]:
                return np.broadcast_to(self.coefficients[track], (len(left), *self.coefficients.shape[1:]))
            if left[0] == COEFFICIENTS:
                return self.joint(track, right, left).swapaxes(-1, -2)
            return self.cross[track, left][:, :, self.states.shape[-1] :]
        if (left == right).all():
            return self.states[track, left]
        if left[0] > right[0]:
            return self.joint(track, right, left).swapaxes(-1, -2)
        return self.cross[track, left][:, :, : self.states.shape[-1]]


class SquareRootInformation:
    """The triangles R of several tracks.

    Args: roots: one a track, all with as many coefficients.

    Attributes:
        tracks: their number t.  lengths: (t,) number of states of each.
        width: numbers w of a state, biases among them.  coefficients: number p of them.
    """

    def __init__(self, roots: Sequence[Root]) -> None:
        self.roots = tuple(roots)
        self.tracks, self.lengths = len(roots), np.array([len(root.states) for root in roots])
        self.width, self.coefficients = roots[0].width, len(roots[0].coefficients)

    def log_determinants(self) -> Array:
        """(t,) log det R, dimensionless."""
        w, p = self.width, self.coefficients
        own = [np.diagonal(root.states[:, :, :w], axis1=1, axis2=2) for root in self.roots]
        shared = [np.diagonal(root.coefficients[:, 2 * w : 2 * w + p]) for root in self.roots]
        return np.array([np.log(np.abs(a)).sum() + np.log(np.abs(b)).sum() for a, b in zip(own, shared, strict=True)])

    def covariances(self) -> NeighbourCovariances:
        """Blocks of (R^T R)^-1 of all tracks."""
        t, n, w, p = self.tracks, max(self.lengths), self.width, self.coefficients
        found = NeighbourCovariances(np.zeros((t, n, w, w)), np.zeros((t, n, w, w + p)), np.zeros((t, p, p)))
        for k, (root, length) in enumerate(zip(self.roots, self.lengths, strict=True)):
            states, cross = found.states[k, :length], found.cross[k, :length]
            covariances_of(root, states, cross, found.coefficients[k])
        return found


def marginal_covariances(root: Root) -> Covariances:
    """Covariances of the states and coefficients of one track."""
    (n, w), p = root.states.shape[:2], len(root.coefficients)
    states, cross, coefficients = np.empty((n, w, w)), np.empty((n, w, w + p)), np.empty((p, p))
    covariances_of(root, states, cross, coefficients)
    return Covariances(states, coefficients, cross[:, :, w:])
