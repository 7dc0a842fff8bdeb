"""By how much two views contradict each other: the distance, in pixels, of two rays from lying in one plane."""

import numpy as np

from ballfg.vision.arrays import Array
from ballfg.vision.camera import Camera

NEAREST = 0.1
"""m, least distance from either camera at which two rays may meet."""


def epipolar_miss(first: Camera, second: Camera, pixels: Array, others: Array) -> tuple[Array, Array]:
    """Sampson distance of pairs of pixels from the epipolar constraint.

    Two rays d1, d2 from centres that are b apart lie in a plane if e = d1 . (b x d2) is zero. To first order the least
    correction of the four pixel coordinates that makes it so is e / |grad e|, the value returned. Where it is measured
    with sigma px in every coordinate, its own standard deviation is sigma.

    Args: pixels: (n, 2) in the first camera; NaN where unknown.  others: (n, 2) in the second.
    Returns: the distance (n,), signed, px; NaN where unknown or where the rays do not meet in front of both cameras;
        and the unit gradient (n, 4) by the coordinates of both pixels.
    Source: R. Hartley, A. Zisserman, Multiple View Geometry in Computer Vision, 2004, section 11.4.3.
    """
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(others).all(axis=1)
    miss, gradient = np.full(len(pixels), np.nan), np.full((len(pixels), 4), np.nan)
    ones = np.ones((int(known.sum()), 1))
    rays = np.concatenate((first.normalized(pixels[known]), ones), axis=1) @ first.rotation
    towards = np.concatenate((second.normalized(others[known]), ones), axis=1) @ second.rotation
    between = second.centre - first.centre
    normal, other_normal = np.cross(between, towards), np.cross(rays, between)
    by_first = normal @ first.rotation[:2].T / first.matrix[[0, 1], [0, 1]]
    by_second = other_normal @ second.rotation[:2].T / second.matrix[[0, 1], [0, 1]]
    slopes = np.concatenate((by_first, by_second), axis=1)
    size = np.linalg.norm(slopes, axis=1)
    meets = (_distances(rays, towards, between) > NEAREST).all(axis=1) & (size > 0.0)
    size[~meets] = np.nan
    miss[known] = (rays * normal).sum(axis=1) / size
    gradient[known] = slopes / size[:, None]
    return miss, gradient


def _distances(rays: Array, towards: Array, between: Array) -> Array:
    """(n, 2) m, how far along the two rays they are closest; NaN where parallel."""
    a, b, c = (rays**2).sum(axis=1), (rays * towards).sum(axis=1), (towards**2).sum(axis=1)
    d, e = rays @ between, towards @ between
    determinant = a * c - b**2
    determinant[determinant <= 0.0] = np.nan
    return np.stack(((c * d - b * e) / determinant, (b * d - a * e) / determinant), axis=1)
