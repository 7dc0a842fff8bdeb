"""Matches pieces of different cameras whose rays meet, frame after frame.

The distance between rays of right pairs is not known beforehand: a camera that was nudged by half a degree is off by
nine pixels. It is measured first, for each pair of cameras, on the pairs of pieces that choose each other over a long
time; then all pairs are judged by that scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.vision.association.paths import Path
from ballfg.vision.camera import Camera

WORST_OFFSET: Final = 5.0  # px, prior standard deviation of a calibration's error
LEAST_OFFSET: Final = 0.3  # px, least error of a calibration in the matching
_SIGNIFICANT: Final = 0.5  # least excess of the miss of right pairs' rays, as a share of the noise's variance
_MEDIAN_SQUARE: Final = 0.4549  # median of the square of a standard normal number
_GATE: Final = 9.0  # squared deviations at which two pieces part: 3 sigma of calibration and noise together
_LEAST_COMMON: Final = 2  # times at which both pieces must be known; a track that ends just after a bounce has no more
_LEAST_SUPPORT: Final = 1.5  # common times that must speak for a pair, less what speaks against it
_LONG: Final = 8  # common times from which a pair of pieces says something about the calibration
_SPEEDING: Final = 2.0  # largest excess of a speed between two pieces over those of both: at a bounce or a hit
_NEARBY: Final = 15.0  # px, how far apart two successive pieces of one camera may be at least, however slow they are
_NEAREST: Final = 0.1  # m, least distance from either camera at which two rays may meet


@dataclass(frozen=True, eq=False)
class Piece:
    """A smoothly moving object in one camera."""

    camera: int  # number of the camera
    rows: Index  # (k,) its candidates
    path: Path  # its place in the image, over true time

    @property
    def start(self) -> float:
        """s, true time of the first sample."""
        return float(self.path.times[0])

    @property
    def end(self) -> float:
        """s, true time of the last sample."""
        return float(self.path.times[-1])


@dataclass(frozen=True)
class _Pair:
    """Two pieces of different cameras at their common times."""

    first: int
    second: int
    misses: Array  # px, distance between the rays; NaN where they do not meet in front
    variances: Array  # (k,) px^2, of the misses by noise and interpolation

    def support(self, offset: float) -> float:
        """Common times that support the pair, less those against it. `offset`: px, of calibration."""
        square = self.misses**2 / (self.variances + offset**2)
        square = np.where(np.isnan(square), 2.0 * _GATE, np.minimum(square, 2.0 * _GATE))
        return float((1.0 - square / _GATE).sum())


def match(pieces: Sequence[Piece], cameras: Sequence[Camera]) -> tuple[list[list[int]], float]:
    """Groups the pieces of the same object. A group holds no two pieces of a camera at the same time.

    Returns: numbers of the pieces of each group, unmatched ones left out, in the order of the first; px, excess miss of
        rays of one object beyond noise, in the worst pair of cameras; 0 without any.
    """
    pairs = _pairs(pieces, cameras)
    offsets = _offsets(pieces, pairs, len(cameras))
    supported = []
    for pair in pairs:
        offset = offsets.get((pieces[pair.first].camera, pieces[pair.second].camera), WORST_OFFSET)
        support = pair.support(min(max(offset, LEAST_OFFSET), 2.0 * WORST_OFFSET))
        if support > _LEAST_SUPPORT:
            supported.append((support, pair.first, pair.second))
    supported.sort(key=lambda link: (-link[0], link[1], link[2]))
    against = {(pair.first, pair.second) for pair in pairs} - {(first, second) for _, first, second in supported}
    return _grouped(pieces, supported, against), max(offsets.values(), default=0.0)


def _pairs(pieces: Sequence[Piece], cameras: Sequence[Camera]) -> list[_Pair]:
    """All pairs of pieces of different cameras that overlap, compared in one call for each pair of cameras."""
    pairs = []
    camera = np.array([piece.camera for piece in pieces])
    starts, ends = (np.array([piece.path.times[place] for piece in pieces]) for place in (0, -1))
    for one, other in combinations(range(len(cameras)), 2):
        common: dict[tuple[int, int], tuple[Array, Array, Array, Array]] = {}
        for i in np.flatnonzero(camera == one).tolist():
            for j in np.flatnonzero((camera == other) & (starts < ends[i]) & (ends > starts[i])).tolist():
                common[i, j] = _common(pieces[i], pieces[j])
        meeting = [ij for ij, arrays in common.items() if len(arrays[0]) >= _LEAST_COMMON]
        if not meeting:
            continue
        seen = [common[ij] for ij in meeting]
        pixels, spread, others, other_spread = (np.concatenate(arrays) for arrays in zip(*seen, strict=True))
        misses, slopes = epipolar_miss(cameras[one], cameras[other], pixels, others)
        variances = _along(slopes[:, :2], spread) + _along(slopes[:, 2:], other_spread)
        cuts = np.cumsum([len(arrays[0]) for arrays in seen])[:-1]
        cut = zip(meeting, np.split(misses, cuts), np.split(variances, cuts), strict=True)
        pairs += [_Pair(*ij, miss, variance) for ij, miss, variance in cut]
    return pairs


def _common(first: Piece, second: Piece) -> tuple[Array, Array, Array, Array]:
    """Pixels and covariances of both pieces at those samples of the sparser one at which the other is known."""
    swap = len(first.path.times) > len(second.path.times)
    sparse, dense = (second, first) if swap else (first, second)
    inside = (sparse.path.times >= dense.start) & (sparse.path.times <= dense.end)
    values, covariances = dense.path.at(sparse.path.times[inside])
    known = np.isfinite(values).all(axis=1)
    mine = sparse.path.values[inside][known], sparse.path.covariances[inside][known]
    theirs = values[known], covariances[known]
    return (*theirs, *mine) if swap else (*mine, *theirs)


def _along(slopes: Array, covariances: Array) -> Array:
    return np.asarray(np.einsum("ni,nij,nj->n", slopes, covariances, slopes))


def _offsets(pieces: Sequence[Piece], pairs: Sequence[_Pair], count: int) -> dict[tuple[int, int], float]:
    """px, by how much rays of right pairs miss each other beyond noise, for pairs of cameras that tell."""
    best: dict[tuple[int, int], tuple[float, _Pair]] = {}
    for pair in pairs:
        support = pair.support(WORST_OFFSET)
        for piece, camera in ((pair.first, pieces[pair.second].camera), (pair.second, pieces[pair.first].camera)):
            if support > best.get((piece, camera), (0.0, pair))[0]:
                best[piece, camera] = (support, pair)
    offsets = {}
    for one, other in combinations(range(count), 2):
        chosen = [pair for (piece, to), (_, pair) in best.items() if pieces[piece].camera == one and to == other]
        mutual = [pair for pair in chosen if best.get((pair.second, one), (0.0, None))[1] is pair]
        long = [pair for pair in mutual if len(pair.misses) >= _LONG]
        square = np.concatenate([np.zeros(0), *(pair.misses**2 for pair in long)])
        variance = np.concatenate([np.zeros(0), *(pair.variances for pair in long)])
        known = np.isfinite(square)
        if known.any():
            beyond = float(np.median(square[known] / variance[known])) / _MEDIAN_SQUARE - 1.0
            noise = float(np.median(variance[known]))
            offsets[one, other] = float(np.sqrt(beyond * noise)) if beyond > _SIGNIFICANT else 0.0
    return offsets


def _grouped(
    pieces: Sequence[Piece], supported: Sequence[tuple[float, int, int]], against: set[tuple[int, int]]
) -> list[list[int]]:
    """Joins pieces along their links, the best supported first, unless the pieces exclude each other."""
    group_of = {number: [number] for _, *ends in supported for number in ends}
    for _, first, second in supported:
        one, other = group_of[first], group_of[second]
        if one is not other and all(_may_join(pieces, a, b, against) for a in one for b in other):
            one.extend(other)
            for number in other:
                group_of[number] = one
    return sorted({id(group): sorted(group) for group in group_of.values() if len(group) > 1}.values())


def _may_join(pieces: Sequence[Piece], a: int, b: int, against: set[tuple[int, int]]) -> bool:
    if pieces[a].camera != pieces[b].camera:
        return (a, b) not in against and (b, a) not in against
    first, second = sorted((pieces[a], pieces[b]), key=lambda piece: piece.start)
    apart = second.start - first.end
    if apart <= 0.0:
        return False
    speed = max(_speed(first.path), _speed(second.path))
    distance = float(np.linalg.norm(second.path.values[0] - first.path.values[-1]))
    return distance <= _SPEEDING * speed * apart + _NEARBY


def _speed(path: Path) -> float:
    """px/s, mean over the piece."""
    lengths = np.linalg.norm(np.diff(path.values, axis=0), axis=1)
    return float(lengths.sum() / (path.times[-1] - path.times[0]))


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
    rays = first.directions(pixels[known]) @ first.rotation
    towards = second.directions(others[known]) @ second.rotation
    between = second.centre - first.centre
    normal, other_normal = np.cross(between, towards), np.cross(rays, between)
    by_first = normal @ first.rotation[:2].T / first.matrix[[0, 1], [0, 1]]
    by_second = other_normal @ second.rotation[:2].T / second.matrix[[0, 1], [0, 1]]
    slopes = np.concatenate((by_first, by_second), axis=1)
    size = np.linalg.norm(slopes, axis=1)
    a, b, c = (rays**2).sum(axis=1), (rays * towards).sum(axis=1), (towards**2).sum(axis=1)
    d, e = rays @ between, towards @ between
    determinant = a * c - b**2
    determinant[determinant <= 0.0] = np.nan  # parallel
    along = np.stack(((c * d - b * e) / determinant, (b * d - a * e) / determinant))  # m, where they are closest
    meets = (along > _NEAREST).all(axis=0) & (size > 0.0)
    size[~meets] = np.nan
    miss[known] = (rays * normal).sum(axis=1) / size
    gradient[known] = slopes / size[:, None]
    return miss, gradient
