"""The graph of a camera that stands at one place, turns and zooms, solved with GTSAM.

Unknowns are the place (Point3) of a shot, its lens, how far each line is off in all pictures, and of each picture the
rotation (Rot3) and the logarithm of the focal length. Measurements are the ridges of the court's lines in each picture,
across the lines, and background points that were matched between neighbouring pictures: a turn and a zoom about one
place is a homography. Each residual r has Cauchy's loss, s^2 log(1 + (r / s)^2), as the square of a residual of that
size, so that the graph's least squares is the robust problem itself. The noise is that which the residuals show; of
many that err together the loss counts less.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import gtsam
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.vision.broadcast.background import Match
from ballfg.vision.broadcast.lines import Ridges
from ballfg.vision.broadcast.pinhole import Pinhole, undone

RIDGE_SIGMA, MATCH_SIGMA = 0.1, 0.15
"""px, of a ridge's place and of a background point's motion, at first; then what the recording shows, line by line."""
LEAST_SIGMA: Final = 0.01
"""px, of these."""
LINE_SIGMA, LINES_KNOWN = 0.05, 4.0
"""px, by which a line is off in all pictures, at first: it was painted so, or its net sags, or the ground beside it
moves it; then what the lines show, with this as that of so many lines more."""
SHARED, TOGETHER = 10.0, 40.0
"""Ridges of a line, in a picture and in those after it, err together, and matches of neighbouring points do: so many
count as one. Rendered seeds 700 - 718 and the real rally chose it."""
ROUNDS: Final = 3
"""In which the noise is found."""
ROBUST: Final = 2.0
"""Scale of Cauchy's loss, in standard deviations."""
PLACE, LENS, LINES = gtsam.symbol("p", 0), gtsam.symbol("l", 0), gtsam.symbol("c", 0)
STEPS, ROUGH, SETTLED = 30, 1e-3, 1e-5
"""Of the minimiser at most, and the relative change of the sum of squares that ends it, while the noise is looked for
and at last."""
PLACE_SIGMA, FOCAL_SIGMA, BEND_SIGMA = 30.0, 1.0, 0.1
"""m, and of the logarithm: priors about the first values, far wider than what the court tells. Of k1, about none:
lenses of broadcasts have up to 0.2."""


@dataclass(frozen=True, eq=False)
class Solved:
    """Cameras of a shot; covariances (n, 7, 7) of turn (rad, in the camera's frame), place (m), log focal length."""

    cameras: tuple[Pinhole, ...]
    covariances: Array


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations, px: `ridges` (l,) of a ridge's place about its line, `lines` of the lines, `matches`."""

    ridges: Array
    lines: float
    matches: float


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Rotations (n, 3, 3) from the world and focal lengths (n,) px; place (3,) m, lens, shifts of the lines (l,) px."""

    turn: Array
    focal: Array
    place: Array
    bend: float
    off: Array

    @classmethod
    def of(cls, values: gtsam.Values, count: int) -> Unknowns:
        """Those of so many pictures."""
        turn = np.array([values.atRot3(_turn(k)).matrix().T for k in range(count)])
        focal = np.exp([values.atVector(_zoom(k))[0] for k in range(count)])
        place, bend = np.asarray(values.atPoint3(PLACE)), float(values.atVector(LENS)[0])
        return cls(turn, focal, place, bend, values.atVector(LINES))


def solve(cameras: Sequence[Pinhole], seen: Sequence[Ridges | None], matched: Sequence[Match]) -> Solved:
    """The most probable cameras of a shot, and the noise with which the measurements are most probable.

    Args:
        cameras: first values, all at about one place.  seen: ridges of each picture, None where they do not count.
        matched: background of each picture with that of the one before, one less than cameras.
    """
    lines = max((len(one.asked) for one in seen if one is not None), default=1)
    first = gtsam.Values()
    first.insert(PLACE, gtsam.Point3(np.median([one.place for one in cameras], axis=0)))
    first.insert(LENS, np.zeros(1))
    first.insert(LINES, np.zeros(lines))
    for k, one in enumerate(cameras):
        first.insert(_turn(k), gtsam.Rot3(one.turn.T))
        first.insert(_zoom(k), np.array([np.log(one.focal)]))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(STEPS)
    found, noise = first, Noise(np.full(lines, RIDGE_SIGMA), LINE_SIGMA, MATCH_SIGMA)
    for number in range(ROUNDS):
        settings.setRelativeErrorTol(ROUGH if number < ROUNDS - 1 else SETTLED)
        court, background = CourtLines(cameras, seen, noise), Background(cameras, matched, noise)
        graph = _graph(court, background, first, noise)
        found = gtsam.LevenbergMarquardtOptimizer(graph, found, settings).optimize()
        marginals = gtsam.Marginals(graph, found)
        if number < ROUNDS - 1:
            noise = _noise(court, background, Unknowns.of(found, len(cameras)), marginals, noise)
    at, solved, covariances = Unknowns.of(found, len(cameras)), list[Pinhole](), list[Array]()
    for k, one in enumerate(cameras):
        solved.append(replace(one, turn=at.turn[k], place=at.place, focal=float(at.focal[k]), bend=at.bend))
        joint = marginals.jointMarginalCovariance(gtsam.KeyVector([_turn(k), PLACE, _zoom(k)]))
        keys = (_turn(k), PLACE, _zoom(k))
        covariances.append(np.block([[joint.at(a, b) for b in keys] for a in keys]))
    return Solved(tuple(solved), np.stack(covariances))


def _graph(court: CourtLines, background: Background, first: gtsam.Values, noise: Noise) -> gtsam.NonlinearFactorGraph:
    """The graph of a shot. Args: first: values about which the priors are."""
    graph, count = gtsam.NonlinearFactorGraph(), len(noise.ridges)
    wide = gtsam.noiseModel.Isotropic.Sigma(3, PLACE_SIGMA)
    graph.add(gtsam.PriorFactorPoint3(PLACE, first.atPoint3(PLACE), wide))
    graph.add(gtsam.PriorFactorVector(LENS, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, BEND_SIGMA)))
    graph.add(gtsam.PriorFactorVector(LINES, np.zeros(count), gtsam.noiseModel.Isotropic.Sigma(count, noise.lines)))
    wide = gtsam.noiseModel.Isotropic.Sigma(1, FOCAL_SIGMA)
    for k in range(court.count):
        graph.add(gtsam.PriorFactorVector(_zoom(k), first.atVector(_zoom(k)), wide))
    for batch in (court, background):
        for number in range(len(batch.keys)):
            graph.add(batch.factor(number))
    return graph


def _noise(court: CourtLines, background: Background, at: Unknowns, marginals: gtsam.Marginals, noise: Noise) -> Noise:
    """The noise with which what is left is most probable, one step nearer.

    With Cauchy's loss its square is the mean of the squares, with the loss's weights. Lines are few: the posterior's
    variance counts too, as in the EM algorithm.
    """
    count, line = len(noise.ridges), court.line
    square = _weighed(court.left(at)[0], court.sigma)
    ridges = np.bincount(line, square, minlength=count) / np.maximum(np.bincount(line, minlength=count), 1)
    turned = _weighed(background.left(at)[0], background.sigma)
    wide = (at.off**2 + np.diag(marginals.marginalCovariance(LINES))).sum() + LINES_KNOWN * LINE_SIGMA**2
    return Noise(
        np.maximum(np.sqrt(ridges), LEAST_SIGMA),
        float(np.sqrt(wide / (count + LINES_KNOWN))),
        max(float(np.sqrt(turned.sum() / max(turned.size, 1))), LEAST_SIGMA),
    )


def _weighed(left: Array, sigma: Array) -> Array:
    """The squares of residuals with the weights of Cauchy's loss."""
    return np.asarray(left**2 / (1.0 + (left / sigma / ROBUST) ** 2))


def _turn(k: int) -> int:
    return int(gtsam.symbol("r", k))


def _zoom(k: int) -> int:
    return int(gtsam.symbol("f", k))


class Batch(ABC):
    """Measurements of one sort in all pictures, computed together: GTSAM asks for those of one picture at a time.

    Args:
        count: of pictures.  shared: so many measurements count as one.  sigma: (n,) px.
        pictures: those that each factor sees.  rows: (f,) numbers of its measurements.  keys: of its variables.
    """

    def __init__(
        self,
        count: int,
        shared: float,
        sigma: Array,
        pictures: Sequence[list[int]],
        rows: Sequence[int],
        keys: Sequence[list[int]],
    ) -> None:
        self.count, self.shared, self.sigma, self.pictures, self.keys = count, shared, sigma, pictures, keys
        self.ends, self.marks = np.cumsum([0, *rows]), [b""] * len(keys)
        self.picture = np.repeat(np.array([seen[-1] for seen in pictures], dtype=np.int64), rows)

    @abstractmethod
    def left(self, at: Unknowns) -> tuple[Array, tuple[Array, ...]]:
        """What is left of all measurements (n,) px, and its derivatives (n, d) by each variable of their factors."""

    def factor(self, number: int) -> gtsam.CustomFactor:
        """The factor of one picture, or of one and that before it; answers from what all have at the same values."""

        def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
            if _mark(values, self.pictures[number]) != self.marks[number]:
                left, slopes = self.left(Unknowns.of(values, self.count))
                self.robust, scale = _robust(left / self.sigma)
                self.slopes = [(scale / self.sigma)[:, None] * slope for slope in slopes]
                self.marks = [_mark(values, pictures) for pictures in self.pictures]
            if H is not None:
                for place, slope in enumerate(self.slopes):
                    H[place] = np.asfortranarray(slope[rows])
            return self.robust[rows]

        rows = slice(*self.ends[number : number + 2].tolist())
        shared = gtsam.noiseModel.Isotropic.Sigma(rows.stop - rows.start, np.sqrt(self.shared))
        return gtsam.CustomFactor(shared, gtsam.KeyVector(self.keys[number]), error)


def _mark(values: gtsam.Values, pictures: list[int]) -> bytes:
    """The bytes of all values that the measurements in some pictures depend on."""
    own = [part for k in pictures for part in (values.atRot3(_turn(k)).matrix(), values.atVector(_zoom(k)))]
    shared = (values.atPoint3(PLACE), values.atVector(LENS), values.atVector(LINES))
    return b"".join([part.tobytes() for part in (*own, *shared)])


class CourtLines(Batch):
    """Ridges, across the lines. Args: cameras: from which those of the pictures differ little.  seen: as of `solve`."""

    def __init__(self, cameras: Sequence[Pinhole], seen: Sequence[Ridges | None], noise: Noise) -> None:
        used = [(k, one) for k, one in enumerate(seen) if one is not None and len(one.offset)]
        self.line: Index = np.concatenate([np.zeros(0, dtype=np.int64), *(one.line for _, one in used)])
        keys = [[_turn(k), PLACE, _zoom(k), LENS, LINES] for k, _ in used]
        rows = [len(one.offset) for _, one in used]
        super().__init__(len(cameras), SHARED, noise.ridges[self.line], [[k] for k, _ in used], rows, keys)
        self.points = np.concatenate([np.zeros((0, 3)), *(one.points for _, one in used)])
        self.normal = np.concatenate([np.zeros((0, 2)), *(one.normal for _, one in used)])
        away = [cameras[k].project(one.points) - cameras[k].middle for k, one in used]
        offset = np.concatenate([np.zeros(0), *(one.offset for _, one in used)])
        self.seen = (self.normal * np.concatenate([np.zeros((0, 2)), *away])).sum(axis=1) + offset

    def left(self, at: Unknowns) -> tuple[Array, tuple[Array, ...]]:
        """From the ridges to the lines; by turn, place, log focal length, lens, and shifts of the lines."""
        turn = at.turn[self.picture]
        place = (turn @ (self.points - at.place)[..., None])[..., 0]
        across, by_place, by_lens = _across(place, at.focal[self.picture], at.bend, self.normal)
        moved, shifted = -(by_place[:, None] @ turn)[:, 0], np.eye(len(at.off))[self.line]
        slopes = (np.cross(by_place, place), moved, across[:, None], by_lens, shifted)
        return across + at.off[self.line] - self.seen, slopes


class Background(Batch):
    """Matched background, where that of the picture before turns to: of a direction d, R_k^T R_(k-1) d."""

    def __init__(self, cameras: Sequence[Pinhole], matched: Sequence[Match], noise: Noise) -> None:
        pairs, middle = [[k, k + 1] for k in range(len(matched))], cameras[0].middle
        self.before = np.concatenate([np.zeros((0, 2)), *(one.before for one in matched)]) - middle
        self.now = (np.concatenate([np.zeros((0, 2)), *(one.now for one in matched)]) - middle).ravel()
        self.normal = np.tile(np.eye(2), (len(self.before), 1))  # along x and along y
        keys = [[_turn(j), _turn(k), _zoom(j), _zoom(k), LENS] for j, k in pairs]
        rows = [2 * len(one.now) for one in matched]
        super().__init__(len(cameras), TOGETHER, np.full(len(self.now), noise.matches), pairs, rows, keys)

    def left(self, at: Unknowns) -> tuple[Array, tuple[Array, ...]]:
        """To where the points should be; by the turns of both pictures, their log focal lengths, and lens."""
        turn = (at.turn[1:] @ at.turn[:-1].swapaxes(1, 2))[self.picture - 1]
        plane = undone(self.before / at.focal[self.picture[::2] - 1, None], at.bend)
        own = np.repeat(np.concatenate((plane, np.ones((len(plane), 1))), axis=1), 2, axis=0)
        place, square = (turn @ own[..., None])[..., 0], (own[:, :2] ** 2).sum(axis=1)
        across, by_place, by_lens = _across(place, at.focal[self.picture], at.bend, self.normal)
        by_own = (by_place[:, None] @ turn)[:, 0]
        # of undoing the distortion, which moves a point along its distance from the middle
        outward = (by_own * own)[:, :2].sum(axis=1) / (1.0 + 3.0 * at.bend * square)
        by_zoom, by_lens = -outward * (1.0 + at.bend * square), by_lens - (outward * square)[:, None]
        slopes = (-np.cross(by_own, own), np.cross(by_place, place), by_zoom[:, None], across[:, None], by_lens)
        return across - self.now, slopes


def _across(place: Array, focal: Array, bend: float, normal: Array) -> tuple[Array, Array, Array]:
    """(n,) px from the middle along normals (n, 2), where cameras see places (n, 3) m in their frames.

    Returns: it, and its derivatives by the places (n, 3) and by the distortion (n, 1).
    """
    plane, focal = place[:, :2] / place[:, 2:], focal[:, None]
    square, along = (plane**2).sum(axis=1)[:, None], (normal * plane).sum(axis=1)[:, None]
    by_plane = focal * ((1.0 + bend * square) * normal + 2.0 * bend * along * plane)
    by_place = np.concatenate((by_plane, -(by_plane * plane).sum(axis=1)[:, None]), axis=1) / place[:, 2:]
    return (focal * (1.0 + bend * square) * along)[:, 0], by_place, focal * square * along


def _robust(left: Array) -> tuple[Array, Array]:
    """Residuals whose squares are Cauchy's loss of the given ones, and their derivatives by these."""
    square = (left / ROBUST) ** 2
    size = ROBUST * np.sqrt(np.log1p(square))
    small = np.abs(left) < 1e-4
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(small, 1.0, np.abs(left) / ((1.0 + square) * size))
    return np.where(small, left, np.sign(left) * size), scale
