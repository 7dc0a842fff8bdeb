"""Keeps covariances positive definite under rounding, however many decades their numbers span.

All functions use correlations: positions of a micrometre beside velocities of 20 m/s and gaps of 100 s leave
eigenvalues that double precision cannot tell from zero, or from a little less. The remedy is shrinkage: correlations
times 1 - a, standard deviations as they are, with the smallest a that makes the matrix positive definite. A positive
definite covariance stays as it is.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import FLAG, NOTHING, REAL, THREE, TWO

MARGIN = 1e-13
"""Smallest eigenvalue of an unchanged correlation matrix: of smaller ones rounding decides the sign."""
FIRST_SHRINKAGE = 1e-12
"""First shrinkage of correlations; it grows tenfold until the matrix is positive definite."""


def definite(covariance: Array) -> Array:
    """Covariances (..., d, d), symmetric and positive definite; those that were already change by rounding at most.

    Args: covariance: (..., d, d) in the products of any units, with finite numbers and positive variances.
    """
    symmetric = 0.5 * (covariance + covariance.swapaxes(-1, -2))
    if _all_definite(symmetric):
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
    shape, size = vectors.shape, vectors.shape[-1]
    roots, own = np.array(definite(covariance).reshape(-1, size, size)), vectors.reshape(-1, size).copy()
    if not _roots(roots, 0.0):
        raise np.linalg.LinAlgError("Matrix is not positive definite")
    _divide(roots, own)
    return own.reshape(shape)


def joint_covariance(own: Array, cross: Array, shared: Array) -> Array:
    """(..., d + p, d + p) from covariances (..., d, d) of own and (p, p) of shared numbers, and those between them."""
    both = np.broadcast_to(shared, (*own.shape[:-2], *shared.shape))
    return np.block([[own, cross], [cross.swapaxes(-1, -2), both]])


def compatible(cross: Array, own: Array, shared: Array) -> Array:
    """Covariances (n, d, p) between own and shared variables, shrunk until compatible with the covariances of both.

    Args: cross: (n, d, p).  own: (n, d, d), positive definite.  shared: (p, p), positive definite.
    """
    if not shared.size or _all_definite(joint_covariance(own, cross, shared)):
        return cross
    cross = cross.copy()
    for one, mine in zip(cross, own, strict=True):
        share = FIRST_SHRINKAGE
        while not _all_definite(joint_covariance(mine, one, shared)):
            one *= 1.0 - min(share, 1.0)
            share *= 10.0
    return cross


def _all_definite(symmetric: Array) -> bool:
    """True if the correlations of all covariances (..., d, d) are positive definite with a margin."""
    return bool(_roots(np.array(symmetric, order="C").reshape(-1, *symmetric.shape[-2:]), MARGIN))


@machine_code(FLAG(THREE, REAL))
def _roots(covariances: Array, margin: float) -> bool:
    """Replaces covariances (n, d, d) by lower triangles: S L with S the sigmas, L L^T the correlations less a margin.

    Returns: False if there is no such triangle for one of them.
    """
    d = covariances.shape[1]
    sigma = np.empty(d)
    for c in covariances:
        for i in range(d):
            sigma[i] = math.sqrt(c[i, i])
        for i in range(d):
            for j in range(i + 1):
                left = c[i, j] / sigma[i] / sigma[j] - (margin if i == j else 0.0)
                for k in range(j):
                    left -= c[i, k] * c[j, k]
                if i > j:
                    c[i, j] = left / c[j, j]
                elif left > 0.0:
                    c[i, i] = math.sqrt(left)
                else:
                    return False
        for i in range(d):
            for j in range(i + 1):
                c[i, j] *= sigma[i]
    return True


@machine_code(NOTHING(THREE, TWO))
def _divide(roots: Array, vectors: Array) -> None:
    """Divides vectors (n, d) by lower triangles (n, d, d)."""
    for r in range(len(vectors)):
        for i in range(vectors.shape[1]):
            for k in range(i):
                vectors[r, i] -= roots[r, i, k] * vectors[r, k]
            vectors[r, i] /= roots[r, i, i]


def _shrunk(symmetric: Array) -> Array:
    sigma = np.sqrt(np.diagonal(symmetric))
    correlation = symmetric / sigma[:, None] / sigma[None, :]
    shrinkage, whole = 0.0, np.eye(len(sigma))
    shrunk = correlation
    while not _all_definite(shrunk):
        shrinkage = min(10.0 * shrinkage, 1.0) or FIRST_SHRINKAGE
        shrunk = (1.0 - shrinkage) * correlation + shrinkage * whole
        np.fill_diagonal(shrunk, 1.0)
    return np.asarray(shrunk * sigma[:, None] * sigma[None, :])
