"""Priors: a state, its spin alone, or the shared coefficients are known to some standard deviation."""

from __future__ import annotations

import numpy as np

from ballfg.factors.kind import COEFFICIENTS, Array, FactorKind, Index
from ballfg.factors.loss import Loss
from ballfg.state import SPIN, STATE_DIM


class PriorFactors(FactorKind):
    """r = W (x_i - mean_i), W (r, d): rows of W may look at a part of the variable only.

    Args:
        variables: (m,) state indices, or `COEFFICIENTS`.
        mean: (m, d).
        information_root: (m, r, d) matrices W.
    """

    def __init__(self, variables: Index, mean: Array, information_root: Array, loss: Loss | None = None) -> None:
        super().__init__(np.asarray(variables)[:, None], information_root.shape[1], loss)
        self.mean = mean
        self.information_root = information_root

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, r) and Jacobians (k, r, d)."""
        root = self.information_root[rows]
        return np.einsum("nij,nj->ni", root, inputs[0] - self.mean[rows]), (root,)


def state_prior(state: int, mean: Array, sigma: Array) -> PriorFactors:
    """Prior on one state: mean (9,) and standard deviations (9,)."""
    _check_sigma(sigma)
    return PriorFactors(np.array([state]), mean[None], np.diag(1.0 / sigma)[None])


def spin_prior(states: Index, spin: Array, sigma: Array, loss: Loss | None = None) -> PriorFactors:
    """Priors on the spin of some states, from labels or launcher settings: spin (m, 3) and sigma (m, 3) rad/s."""
    _check_sigma(sigma)
    mean = np.zeros((len(states), STATE_DIM))
    mean[:, SPIN] = spin
    root = np.zeros((len(states), 3, STATE_DIM))
    root[:, :, SPIN] = np.eye(3) / sigma[:, :, None]
    return PriorFactors(states, mean, root, loss)


def coefficient_prior(mean: Array, sigma: Array) -> PriorFactors:
    """Prior on the shared coefficients: mean (p,) and sigma (p,)."""
    _check_sigma(sigma)
    return PriorFactors(np.array([COEFFICIENTS]), mean[None], np.diag(1.0 / sigma)[None])


def _check_sigma(sigma: Array) -> None:
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise ValueError(
            f"sigma must be positive and finite; got {sigma.min():g}. Leave out a prior that says nothing."
        )
