"""Triangulates the rays of several cameras to points with covariances, and leaves out wrong views."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from ballfg.arrays import Array, Mask
from ballfg.checks import check_array, check_each
from ballfg.vision.camera import Camera

MISSED: Final = 1e-6  # share of right candidates that the tests may refuse
MAX_SIGMA: Final = 0.5  # m, standard deviation in the least certain direction, from which rays count as parallel
_GATES: Final = tuple(float(chi2.isf(MISSED, degrees)) for degrees in (1, 2))  # of two rays, of a further view
_STEPS: Final = 3  # Gauss-Newton steps; from halfway between two rays the second moves less than a micrometre
HOPELESS: Final = 1e-6  # information in 1 / `MAX_SIGMA`^2 below which a normal matrix is singular up to rounding
_TINY_ANGLE: Final = 1e-12  # squared sine below which two rays are parallel in float64: halfway between them is nowhere
_AROUND: Final = 0.5 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])  # px, steps of differences


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Points with their support. A row without a point has NaN there and in its covariance, and uses no view."""

    points: Array  # (n, 3) m, world
    covariances: Array  # (n, 3, 3) m^2
    used: Mask  # (n, c) True for views that took part; wrong ones do not
    residuals: Array
    """(n, c, 2) px, seen minus projected, including views that did not take part; NaN without a sighting."""

    def rows(self, chosen: Mask) -> "Triangulated":
        """Some of the rows."""
        return Triangulated(self.points[chosen], self.covariances[chosen], self.used[chosen], self.residuals[chosen])


@dataclass(frozen=True, eq=False)
class _Views:
    """The views of c cameras, in the planes z = 1 of their own frames, where projection is a division."""

    rotations: Array  # (c, 3, 3) from the world to the cameras
    translations: Array  # (c, 3) m
    planes: Array  # (n, c, 2); zero where nothing is seen
    weights: Array  # (n, c, 2, 2) inverse covariances of `planes`
    seen: Mask  # (n, c)

    def project(self, points: Array) -> tuple[Array, Array, Array]:
        """Points (n, 3) -> their planes' coordinates (n, c, 2), derivatives (n, c, 2, 3) and depths (n, c) m."""
        local = np.einsum("cij,nj->nci", self.rotations, points) + self.translations
        depths = local[..., 2]
        safe = np.where(depths > 0.0, depths, np.nan)[..., None]
        planes = local[..., :2] / safe
        derivatives = (self.rotations[:, :2] - planes[..., None] * self.rotations[:, None, 2]) / safe[..., None]
        return planes, derivatives, depths

    def rows(self, chosen: NDArray[np.intp]) -> "_Views":
        """The same cameras, other rows."""
        return _Views(self.rotations, self.translations, self.planes[chosen], self.weights[chosen], self.seen[chosen])


def triangulate(cameras: Sequence[Camera], pixels: ArrayLike, covariances: ArrayLike) -> Triangulated:
    """Points that several cameras see at the same time; wrong candidates are left out, not averaged in.

    Every pair of views proposes a point. A proposal counts if its two rays meet, in front of both cameras, within the
    noise; the views that agree with it join it. The largest agreement wins, then the closest, and is solved by
    Gauss-Newton on the weighted reprojection error. There is no point where no pair agrees, where two proposals of two
    views each agree equally well but not with each other, or where the rays are nearly parallel (`MAX_SIGMA`).

    Args: cameras: c of them, at least two.  pixels: (n, c, 2) px, where each camera saw it; NaN where it did not.
        covariances: (n, c, 2, 2) px^2 of `pixels`; not read where those are NaN.
    Raises: ValueError: shapes that do not fit, fewer than two cameras, covariances that are not positive definite.
    Source: docs/derivations/triangulation.md; Hartley, Zisserman, Multiple View Geometry (2004), sections 12.2 and 5.2.
    """
    cameras = list(check_each("cameras", cameras, Camera, "Read them with read_cameras."))
    pixels, covariances, count = check_array("pixels", pixels), check_array("covariances", covariances), len(cameras)
    if count < 2:
        raise ValueError(f"cameras must be at least two to triangulate; got {count}. Add a camera.")
    if pixels.ndim != 3 or pixels.shape[1:] != (count, 2):
        raise ValueError(f"pixels must have shape (n, {count}, 2) for {count} cameras; got {pixels.shape}")
    if covariances.shape != (*pixels.shape, 2):
        raise ValueError(f"covariances must have shape {(*pixels.shape, 2)}; got {covariances.shape}")
    seen = covariances[np.isfinite(pixels).all(axis=-1)]
    bad = ~((seen[:, 0, 0] > 0.0) & (np.linalg.det(seen) > 0.0)) if len(seen) else np.zeros(0, dtype=bool)
    if bad.any():
        raise ValueError(f"covariances must be positive definite, px^2; got {seen[bad][0].tolist()}")
    views = _views(cameras, pixels, covariances)
    points, used = _consensus(views)
    points, spread = _refined(views, points, used)
    found = np.asarray(np.isfinite(points).all(axis=1) & ((views.project(points)[2] > 0.0) | ~used).all(axis=1))
    found[found] &= np.linalg.eigvalsh(spread[found])[:, -1] <= MAX_SIGMA**2
    points[~found], spread[~found], used[~found] = np.nan, np.nan, False
    residuals = np.full(pixels.shape, np.nan)
    for c, camera in enumerate(cameras):
        residuals[found, c] = pixels[found, c] - camera.project(points[found])
    return Triangulated(points, spread, used, residuals)


def _views(cameras: list[Camera], pixels: Array, covariances: Array) -> _Views:
    seen = np.asarray(np.isfinite(pixels).all(axis=-1))
    planes = np.zeros(pixels.shape)
    weights = np.zeros(covariances.shape)
    for c, camera in enumerate(cameras):
        rows = seen[:, c]
        planes[rows, c] = camera.normalized(pixels[rows, c])
        around = camera.normalized(pixels[rows, c, None] + _AROUND)
        reach = np.stack((around[:, 0] - around[:, 1], around[:, 2] - around[:, 3]), axis=-1)  # by the pixels
        weights[rows, c] = np.linalg.inv(reach @ covariances[rows, c] @ np.swapaxes(reach, 1, 2))
    rotations = np.stack([camera.rotation for camera in cameras])
    return _Views(rotations, np.stack([camera.tvec for camera in cameras]), planes, weights, seen)


def _consensus(views: _Views) -> tuple[Array, Mask]:
    """For every row the proposal with most views, then least error: points (n, 3) (NaN: none), its views (n, c)."""
    n, c = views.seen.shape
    points = np.full((n, 3), np.nan)
    used = np.zeros((n, c), dtype=bool)
    count = np.zeros(n, dtype=int)
    error = np.full(n, np.inf)
    unclear = np.zeros(n, dtype=bool)
    for i, j in combinations(range(c), 2):
        rows = np.flatnonzero(views.seen[:, i] & views.seen[:, j])
        proposed, agree, cost = _proposal(views.rows(rows), i, j)
        votes = agree.sum(axis=1)
        same = (agree == used[rows]).all(axis=1)
        rival = (votes == 2) & (count[rows] == 2) & ~same
        better = (votes >= 2) & ((votes > count[rows]) | ((votes == count[rows]) & (cost < error[rows])))
        unclear[rows] = np.where(votes > np.maximum(count[rows], 1), False, unclear[rows] | rival)
        to = rows[better]
        points[to], used[to], count[to], error[to] = proposed[better], agree[better], votes[better], cost[better]
    unclear &= count == 2
    points[unclear], used[unclear] = np.nan, False
    return points, used


def _proposal(views: _Views, i: int, j: int) -> tuple[Array, Mask, Array]:
    """The point (n, 3) of views i and j, who agrees with it (n, c), and their squared whitened error (n,).

    A further view is judged by its residual's covariance, its own and that of the point: S + J P J'.
    """
    pair = np.zeros(views.seen.shape, dtype=bool)
    pair[:, [i, j]] = True
    points, spread = _refined(views, _halfway(views, i, j), pair)
    planes, derivatives, depths = views.project(points)
    residuals = planes - views.planes
    cost = np.einsum("nci,ncij,ncj->nc", residuals, views.weights, residuals)
    meets = (cost[:, i] + cost[:, j] <= _GATES[0]) & (depths[:, i] > 0.0) & (depths[:, j] > 0.0)
    agree = pair & meets[:, None]
    total = cost[:, i] + cost[:, j]
    for k in set(range(views.seen.shape[1])) - {i, j}:
        rows = np.flatnonzero(meets & views.seen[:, k] & (depths[:, k] > 0.0))
        by_point = derivatives[rows, k]
        covariance = np.linalg.inv(views.weights[rows, k]) + by_point @ spread[rows] @ np.swapaxes(by_point, 1, 2)
        missed = np.linalg.solve(covariance, residuals[rows, k][..., None])[..., 0]
        distance = np.einsum("ni,ni->n", missed, residuals[rows, k])
        agree[rows, k] = distance <= _GATES[1]
        total[rows] += np.where(agree[rows, k], distance, 0.0)
    return points, agree, total


def _halfway(views: _Views, i: int, j: int) -> Array:
    """(n, 3) the middle of the shortest line between the rays of two views; NaN where they are parallel."""
    local = np.concatenate((views.planes, np.ones((*views.seen.shape, 1))), axis=2)
    sizes = np.linalg.norm(local, axis=2, keepdims=True)
    first, second = (local[:, c] @ views.rotations[c] / sizes[:, c] for c in (i, j))
    centres = [-views.rotations[c].T @ views.translations[c] for c in (i, j)]
    between = centres[1] - centres[0]
    cosine = np.einsum("ni,ni->n", first, second)
    sine2 = 1.0 - cosine**2
    sine2[sine2 < _TINY_ANGLE] = np.nan
    along_first, along_second = first @ between, second @ between
    near = (along_first - cosine * along_second) / sine2
    far = (cosine * along_first - along_second) / sine2
    return np.asarray(0.5 * (centres[0] + near[:, None] * first + centres[1] + far[:, None] * second))


def _refined(views: _Views, points: Array, used: Mask) -> tuple[Array, Array]:
    """Gauss-Newton on the weighted error in the planes: points (n, 3) and covariances (n, 3, 3); NaN where it fails."""
    points = points.copy()
    spread = np.full((len(points), 3, 3), np.nan)
    weights = views.weights * used[..., None, None]
    for _ in range(_STEPS):
        planes, derivatives, _ = views.project(points)
        derivatives = np.where(used[..., None, None], derivatives, 0.0)
        residuals = np.where(used[..., None], planes - views.planes, 0.0)
        weighted = weights @ derivatives
        information = np.einsum("ncij,ncik->njk", derivatives, weighted)
        gradient = np.einsum("ncij,nci->nj", weighted, residuals)
        solvable = np.isfinite(information).all(axis=(1, 2))
        solvable[solvable] &= np.linalg.eigvalsh(information[solvable])[:, 0] * MAX_SIGMA**2 > HOPELESS
        points[~solvable], spread[~solvable] = np.nan, np.nan
        spread[solvable] = np.linalg.inv(information[solvable])
        points[solvable] -= np.einsum("nij,nj->ni", spread[solvable], gradient[solvable])
    return points, spread
