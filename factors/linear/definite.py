"""Keeps covariances positive definite under rounding, however many decades their numbers span.

All functions use correlations: positions of a micrometre beside velocities of 20 m/s and gaps of 100 s leave
eigenvalues that double precision cannot tell from zero, or from a little less. The remedy is shrinkage: correlations
times 1 - a, standard deviations as they are, with the smallest a that makes the matrix positive definite. A positive
definite covariance stays as it is.
"""

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array

MARGIN = 1e-13
"""Smallest eigenvalue of an unchanged correlation matrix: of smaller ones rounding decides the sign."""
FIRST_SHRINKAGE = 1e-12
"""First shrinkage of correlations; it grows tenfold until the matrix is positive definite."""


def definite(covariance: Array) -> Array:
    """Covariances (..., d, d), symmetric and positive definite; those that were already change by rounding at most.

    Args: covariance: (..., d, d) in the products of any units, with finite numbers and positive variances.
    """
    symmetric = 0.5 * (covariance + covariance.swapaxes(-1, -2))
    if _all_definite(_correlation(symmetric)[0]):
        return np.asarray(symmetric)
    flat = symmetric.reshape(-1, *symmetric.shape[-2:])
    return np.stack([_shrunk(one) for one in flat]).reshape(symmetric.shape)


def variances_positive(covariance: Array) -> NDArray[np.bool_]:
    """(...) bool: True if a covariance (..., d, d) has finite numbers and positive variances."""
    finite = np.isfinite(covariance).all(axis=(-1, -2))
    with np.errstate(invalid="ignore"):
        return np.asarray(finite & (np.diagonal(covariance, axis1=-2, axis2=-1) > 0.0).all(axis=-1))


def raised(covariance: Array, least: Array) -> Array:
    """A covariance (d, d) that is positive definite, its standard deviations at least `least` (d,).

    A difference of large numbers may leave a variance of zero or less; the least one replaces it.
    """
    variance = np.diagonal(covariance)
    low = ~(variance >= least**2)
    if low.any():
        covariance = covariance.copy()
        covariance[low, :] = covariance[:, low] = 0.0
        covariance[low, low] = least[low] ** 2
    return definite(covariance)


def whitened(vectors: Array, covariance: Array) -> Array:
    """(..., d) vectors divided by the lower triangular root of their covariances (..., d, d)."""
    covariance = definite(covariance)
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    root = np.linalg.cholesky(covariance / sigma[..., :, None] / sigma[..., None, :])
    return np.asarray(np.linalg.solve(root, (vectors / sigma)[..., None])[..., 0])


def compatible(cross: Array, own: Array, shared: Array) -> Array:
    """Covariances (n, d, p) between own and shared variables, shrunk until compatible with the covariances of both.

    Args: cross: (n, d, p).  own: (n, d, d), positive definite.  shared: (p, p), positive definite.
    """
    if not shared.size or _all_definite(_correlation(_joint(cross, own, shared))[0]):
        return cross
    cross = cross.copy()
    for one, mine in zip(cross, own, strict=True):
        share = FIRST_SHRINKAGE
        while not _all_definite(_correlation(_joint(one, mine, shared))[0]):
            one *= 1.0 - min(share, 1.0)
            share *= 10.0
    return cross


def _joint(cross: Array, own: Array, shared: Array) -> Array:
    both = np.broadcast_to(shared, (*own.shape[:-2], *shared.shape))
    return np.block([[own, cross], [cross.swapaxes(-1, -2), both]])


def _correlation(symmetric: Array) -> tuple[Array, Array]:
    sigma = np.sqrt(np.diagonal(symmetric, axis1=-2, axis2=-1))
    return symmetric / sigma[..., :, None] / sigma[..., None, :], sigma


def _all_definite(correlation: Array) -> bool:
    try:
        np.linalg.cholesky(correlation - MARGIN * np.eye(correlation.shape[-1]))
    except np.linalg.LinAlgError:
        return False
    return True


def _shrunk(symmetric: Array) -> Array:
    correlation, sigma = _correlation(symmetric)
    shrinkage, whole = 0.0, np.eye(len(sigma))
    shrunk = correlation
    while not _all_definite(shrunk):
        shrinkage = min(10.0 * shrinkage, 1.0) or FIRST_SHRINKAGE
        shrunk = (1.0 - shrinkage) * correlation + shrinkage * whole
        np.fill_diagonal(shrunk, 1.0)
    return np.asarray(shrunk * sigma[:, None] * sigma[None, :])
