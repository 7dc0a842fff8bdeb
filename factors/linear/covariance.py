"""Computes covariances of states and coefficients from the triangles of eliminations."""

from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.factors.batch import COEFFICIENTS
from ballfg.factors.linear.definite import definite, joint_covariance, variances_positive
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
        return joint_covariance(self.states[state], self.cross[state], self.coefficients)


@dataclass(frozen=True)
class NeighbourCovariances:
    """Covariances of n states of w numbers (biases among them) and p coefficients, those of neighbours among them.

    Attributes:
        states: (n, w, w).  cross: (n, w, w + p), of each state with the next one and with the coefficients.
        coefficients: (p, p).
    """

    states: Array
    cross: Array
    coefficients: Array

    @classmethod
    def of(cls, root: Root) -> "NeighbourCovariances":
        """Blocks of (R^T R)^-1."""
        (n, w), p = root.states.shape[:2], len(root.coefficients)
        found = cls(np.empty((n, w, w)), np.empty((n, w, w + p)), np.empty((p, p)))
        covariances_of(root, found.states, found.cross, found.coefficients)
        return found

    def joint(self, left: Index, right: Index) -> Array:
        """(m, d, e) covariances of pairs of variables: equal, neighbours, or with the coefficients.

        Args: left: (m,) variable numbers.  right: (m,).
        """
        if left[0] == COEFFICIENTS or right[0] == COEFFICIENTS:
            if left[0] == right[0]:
                return np.broadcast_to(self.coefficients, (len(left), *self.coefficients.shape))
            if left[0] == COEFFICIENTS:
                return self.joint(right, left).swapaxes(-1, -2)
            return self.cross[left][:, :, self.states.shape[-1] :]
        if (left == right).all():
            return self.states[left]
        if left[0] > right[0]:
            return self.joint(right, left).swapaxes(-1, -2)
        return self.cross[left][:, :, : self.states.shape[-1]]


def marginal_covariances(root: Root) -> Covariances:
    """Covariances of the states and coefficients of one track."""
    found = NeighbourCovariances.of(root)
    return Covariances(found.states, found.coefficients, found.cross[:, :, root.width :])
