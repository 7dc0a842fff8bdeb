"""Covariances of states and coefficients from the Bayes nets that the elimination leaves behind.

An elimination gives the square-root information R of a track, R^T R = J^T J, as one row of blocks per state. Backwards
along the track, p(x_i | x_{i+1}, c) is Gaussian with R_i and the coupling S_i to y = (x_{i+1}, c), so that with
K_i = -R_i^-1 S_i the covariance of x_i follows from that of y. Only the triangular R_i are inverted. GTSAM's
`Marginals` goes through Cholesky, which fails for a loose prior beside a tight process noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.factors.batch import COEFFICIENTS


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


@dataclass(frozen=True)
class NeighbourCovariances:
    """Covariances of t tracks with up to n states of w numbers (biases among them) and p coefficients each.

    Attributes:
        states: (t, n, w, w).
        cross: (t, n, w, w + p), of each state with the next one and with the coefficients.
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
            return self.cross[track, left][:, :, self.states.shape[-1] :]
        if (left == right).all():
            return self.states[track, left]
        if left[0] > right[0]:
            return self.joint(track, right, left).swapaxes(-1, -2)
        return self.cross[track, left][:, :, : self.states.shape[-1]]


class SquareRootInformation:
    """The blocks of R of several tracks, side by side.

    Args:
        bayes_nets: GTSAM's, one a track: states 0, 1, ... in order, then the coefficients if there are any.
        lengths: number of states of each track.
        coefficients: number p of coefficients of each.

    Attributes:
        width: numbers w of a state, biases among them.
        inverse: (t, n, w, w) inverses of the diagonal blocks; identities beyond a track's end.
        following: (t, n, w, w) blocks that couple a state to the next one.
        shared: (t, n, w, p) blocks that couple it to the coefficients.
        last: (t, p, p) inverses of the coefficients' own blocks.
    """

    def __init__(self, bayes_nets: Sequence[gtsam.GaussianBayesNet], lengths: Sequence[int], coefficients: int) -> None:
        self.tracks, self.lengths, self.coefficients = len(bayes_nets), np.array(lengths), coefficients
        t, n = self.tracks, max(lengths)
        self.width = w = len(bayes_nets[0].at(0).R())
        root = np.zeros((t, n, w, w))
        root[:] = np.eye(w)  # shorter tracks are filled up with variables that nothing depends on
        self.following = np.zeros((t, n, w, w))
        self.shared = np.zeros((t, n, w, coefficients))
        last = np.zeros((t, coefficients, coefficients))
        for k, (net, length) in enumerate(zip(bayes_nets, lengths, strict=True)):
            for i in range(length):
                conditional = net.at(i)
                root[k, i] = conditional.R()
                self._read_parents(k, i, length, conditional)
            if coefficients:
                last[k] = net.at(length).R()
        self.inverse, self.last = np.linalg.inv(root), np.linalg.inv(last)

    def _read_parents(self, track: int, state: int, length: int, conditional: gtsam.GaussianConditional) -> None:
        column, coupling = 0, conditional.S()
        for key in conditional.keys()[1:]:
            blocks = self.shared if key == length else self.following
            width = blocks.shape[-1]
            blocks[track, state] = coupling[:, column : column + width]
            column += width

    def log_determinants(self) -> Array:
        """(t,) log det R, dimensionless."""
        diagonals = (np.abs(np.diagonal(inverse, axis1=-2, axis2=-1)) for inverse in (self.inverse, self.last))
        states, coefficients = (np.log(diagonal) for diagonal in diagonals)
        return np.asarray(-states.sum((1, 2)) - coefficients.sum(1))

    def covariances(self) -> NeighbourCovariances:
        """Blocks of (R^T R)^-1, by the recursion from the last states back to the first, all tracks in lockstep."""
        gain = -self.inverse @ np.concatenate((self.following, self.shared), axis=-1)
        states, cross = self.inverse @ self.inverse.mT, np.empty_like(gain)
        coefficients = self.last @ self.last.mT
        later = np.zeros((self.tracks, gain.shape[-1], gain.shape[-1]))  # covariance of (x_{i+1}, c)
        w = self.width
        later[:, w:, w:] = coefficients
        for i in range(states.shape[1] - 1, -1, -1):
            cross[:, i] = gain[:, i] @ later
            states[:, i] += cross[:, i] @ gain[:, i].mT
            later[:, :w, :w] = states[:, i]
            own = cross[:, i, :, w:]
            later[:, :w, w:], later[:, w:, :w] = own, own.mT
        return NeighbourCovariances(states, cross, coefficients)


def marginal_covariances(bayes_net: gtsam.GaussianBayesNet, n: int, p: int) -> Covariances:
    """Covariances of one track from a net over states 0..n-1 in order, then p coefficients (none if p is 0)."""
    found = SquareRootInformation([bayes_net], [n], p).covariances()
    return Covariances(found.states[0], found.coefficients[0], found.cross[0, :, :, found.states.shape[-1] :])
