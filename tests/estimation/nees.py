"""Distances of estimates from the truth in the covariances that they state, and where their mean is if those hold."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from ballfg.estimation.result import Estimate
from ballfg.estimation.settings import Settings
from ballfg.factors.loss import Loss

GAUSSIAN = Settings(loss=Loss(), label_loss=Loss(), spin_loss=Loss(), find_events=False)
"""With Gaussian noise alone, so that covariances hold and all estimators are told the same."""


def nees(estimate: Estimate, truth: np.ndarray, part: slice = slice(0, 9)) -> np.ndarray:
    """(n,) squared errors of a part of the states in units of the stated covariance; truth: (n, 9), or up to there."""
    error = estimate.states[:, part] - truth[:, part]
    return np.einsum("ni,ni->n", error, np.linalg.solve(estimate.covariances[:, part, part], error[..., None])[..., 0])


def band(dof: int, count: int) -> tuple[float, float]:
    """99 % of the mean of `count` chi-square numbers."""
    low, high = chi2.ppf([0.005, 0.995], dof * count) / count
    return low, high


def inside(mean: float, dof: int, count: int) -> bool:
    """The mean of `count` chi-square numbers lies in its band."""
    low, high = band(dof, count)
    return bool(low < mean < high)
