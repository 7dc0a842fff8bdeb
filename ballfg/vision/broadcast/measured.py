"""The measurements of a camera's graph as factors: ridges of the court's lines, and background of neighbours.

Each residual r has Cauchy's loss, s^2 log(1 + (r / s)^2), as the square of a residual of that size, so that the graph's
least squares is the robust problem itself. Of many that err together the loss counts less.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.vision.broadcast.background import Match
from ballfg.vision.broadcast.lines import ROBUST, Ridges
from ballfg.vision.broadcast.pinhole import Pinhole, undone

SHARED, TOGETHER = 10.0, 40.0
"""Ridges of a line, in a picture and in those after it, err together, and matches of neighbouring points do: so many
count as one. Rendered seeds 700 - 718 and the real rally chose it."""
LENS, LINES, NEAR, READOUT = (gtsam.symbol(letter, 0) for letter in "lcws")


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations, px: `ridges` (l,) of a ridge's place about its line, `lines` of the lines, `matches`.

    `walk`: m, of each coordinate of the place from one picture to the next; 0 of a camera that stands. `readout`: of
    the time between pictures, prior of that from the first row to the last; 0 of one that sees all rows at once.
    """

    ridges: Array
    lines: float
    matches: float
    walk: float = 0.0
    readout: float = 0.0

    @property
    def moves(self) -> bool:
        """True of a camera with a place of its own in each picture."""
        return self.walk > 0.0


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Rotations (n, 3, 3) from the world and focal lengths (n,) px; places (n, 3) m, lens, shifts of the lines (l,) px.

    `near`: 1/m, one over the distance of the background. `readout`: of the time between pictures.
    """

    turn: Array
    focal: Array
    place: Array
    bend: float
    off: Array
    near: float = 0.0
    readout: float = 0.0

    @classmethod
    def of(cls, values: gtsam.Values, count: int) -> Unknowns:
        """Those of so many pictures."""
        turn = np.array([values.atRot3(turn_key(k)).matrix().T for k in range(count)])
        focal = np.exp([values.atVector(zoom_key(k))[0] for k in range(count)])
        moves = values.exists(NEAR)
        place = np.array([values.atPoint3(place_key(k, moves)) for k in range(count)])
        near, readout = (float(values.atVector(key)[0]) if values.exists(key) else 0.0 for key in (NEAR, READOUT))
        return cls(turn, focal, place, float(values.atVector(LENS)[0]), values.atVector(LINES), near, readout)


@dataclass(frozen=True, eq=False)
class Flow:
    """How fast what stands still moves in the pictures of cameras, with a background at a distance 1 / `near`, m.

    A row of a rolling shutter is seen later than the middle one by readout * `late`, and shows as much of this motion.
    """

    cameras: Sequence[Pinhole]
    near: float = 0.0

    def of_points(self, number: int, points: Array) -> Array:
        """(n, 2) px from one picture to the next, of places (n, 3) m."""
        first, last, steps = self._beside(number)
        return np.asarray((self.cameras[last].project(points) - self.cameras[first].project(points)) / steps)

    def of_background(self, number: int, pixels: Array) -> Array:
        """(n, 2) px from one picture to the next, of what pixels (n, 2) show."""
        first, last, steps = self._beside(number)
        ends = [self.cameras[number].onto(pixels, self.cameras[k], self.near) for k in (first, last)]
        return np.asarray((ends[1] - ends[0]) / steps)

    def late(self, pixels: Array) -> Array:
        """(n, 1) of the readout, by which rows of pixels (n, 2) are seen later than the middle one."""
        return np.asarray((pixels[:, 1:] + 0.5) / self.cameras[0].size[1] - 0.5)

    def _beside(self, number: int) -> tuple[int, int, int]:
        """The pictures before and after, and how many are between them."""
        first, last = max(number - 1, 0), min(number + 1, len(self.cameras) - 1)
        return first, last, max(last - first, 1)


def turn_key(k: int) -> int:
    """Of a picture's rotation (Rot3), from the camera to the world."""
    return int(gtsam.symbol("r", k))


def zoom_key(k: int) -> int:
    """Of the logarithm of a picture's focal length."""
    return int(gtsam.symbol("f", k))


def place_key(k: int, moves: bool) -> int:
    """Of a picture's place (Point3): its own if the camera moves, else that of all."""
    return int(gtsam.symbol("p", k if moves else 0))


class Batch(ABC):
    """Measurements of one sort in all pictures, computed together: GTSAM asks for those of one picture at a time.

    Args:
        count: of pictures.  noise: of all measurements.  shared: so many count as one.  sigma: (n,) px.
        pictures: those that each factor sees.  rows: (f,) numbers of its measurements.  keys: of its variables.
    """

    def __init__(
        self,
        count: int,
        noise: Noise,
        shared: float,
        sigma: Array,
        pictures: Sequence[list[int]],
        rows: Sequence[int],
        keys: Sequence[list[int]],
    ) -> None:
        self.count, self.shared, self.sigma, self.pictures, self.keys = count, shared, sigma, pictures, keys
        self.moves, self.rolls = noise.moves, noise.readout > 0.0
        self.ends, self.marks = np.cumsum([0, *rows]), [b""] * len(keys)
        self.picture = np.repeat(np.array([seen[-1] for seen in pictures], dtype=np.int64), rows)

    @abstractmethod
    def left(self, at: Unknowns) -> tuple[Array, tuple[Array, ...]]:
        """What is left of all measurements (n,) px, and its derivatives (n, d) by each variable of their factors."""

    def factor(self, number: int) -> gtsam.CustomFactor:
        """The factor of one picture, or of one and that before it; answers from what all have at the same values."""

        def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
            if self._mark(values, number) != self.marks[number]:
                left, slopes = self.left(Unknowns.of(values, self.count))
                self.robust, scale = _robust(left / self.sigma)
                self.slopes = [(scale / self.sigma)[:, None] * slope for slope in slopes]
                self.marks = [self._mark(values, every) for every in range(len(self.marks))]
            if H is not None:
                for place, slope in enumerate(self.slopes):
                    H[place] = np.asfortranarray(slope[rows])
            return self.robust[rows]

        rows = slice(*self.ends[number : number + 2].tolist())
        shared = gtsam.noiseModel.Isotropic.Sigma(rows.stop - rows.start, np.sqrt(self.shared))
        return gtsam.CustomFactor(shared, gtsam.KeyVector(self.keys[number]), error)

    def _mark(self, values: gtsam.Values, number: int) -> bytes:
        """The bytes of all values that the measurements of a factor depend on."""
        own = [
            part
            for k in self.pictures[number]
            for part in (
                values.atRot3(turn_key(k)).matrix(),
                values.atVector(zoom_key(k)),
                values.atPoint3(place_key(k, self.moves)),
            )
        ]
        shared = [values.atVector(key) for key in (LENS, LINES, *([NEAR] * self.moves), *([READOUT] * self.rolls))]
        return b"".join([np.asarray(part).tobytes() for part in (*own, *shared)])


class CourtLines(Batch):
    """Ridges, across the lines. Args: cameras: from which those of the pictures differ little.  seen: as of `solve`."""

    def __init__(
        self, cameras: Sequence[Pinhole], seen: Sequence[Ridges | None], noise: Noise, flow: Flow | None = None
    ) -> None:
        used = [(k, one) for k, one in enumerate(seen) if one is not None and len(one.offset)]
        self.line: Index = np.concatenate([np.zeros(0, dtype=np.int64), *(one.line for _, one in used)])
        shared = [LENS, LINES, *([READOUT] if noise.readout else [])]
        keys = [[turn_key(k), place_key(k, noise.moves), zoom_key(k), *shared] for k, _ in used]
        rows = [len(one.offset) for _, one in used]
        super().__init__(len(cameras), noise, SHARED, noise.ridges[self.line], [[k] for k, _ in used], rows, keys)
        self.points = np.concatenate([np.zeros((0, 3)), *(one.points for _, one in used)])
        self.normal = np.concatenate([np.zeros((0, 2)), *(one.normal for _, one in used)])
        away = [cameras[k].project(one.points) - cameras[k].middle for k, one in used]
        offset = np.concatenate([np.zeros(0), *(one.offset for _, one in used)])
        self.seen = (self.normal * np.concatenate([np.zeros((0, 2)), *away])).sum(axis=1) + offset
        self.rolled = np.zeros(len(offset))
        if flow is not None:
            moved = [flow.late(cameras[k].project(one.points)) * flow.of_points(k, one.points) for k, one in used]
            self.rolled = (self.normal * np.concatenate([np.zeros((0, 2)), *moved])).sum(axis=1)

    def left(self, at: Unknowns) -> tuple[Array, tuple[Array, ...]]:
        """From the ridges to the lines; by turn, place, log focal length, lens, shifts of the lines, readout."""
        turn = at.turn[self.picture]
        place = (turn @ (self.points - at.place[self.picture])[..., None])[..., 0]
        across, by_place, by_lens = _across(place, at.focal[self.picture], at.bend, self.normal)
        moved, shifted = -(by_place[:, None] @ turn)[:, 0], np.eye(len(at.off))[self.line]
        slopes = [np.cross(by_place, place), moved, across[:, None], by_lens, shifted]
        slopes += [self.rolled[:, None]] if self.rolls else []
        return across + at.off[self.line] - self.seen + at.readout * self.rolled, tuple(slopes)


class Background(Batch):
    """Matched background, where that of the picture before moves to.

    Seen in a direction d at a distance 1 / w along the axis, it is at R_(k-1)^T d / w + p_(k-1): R_k (R_(k-1)^T d +
    w (p_(k-1) - p_k)) is its direction now. Of a camera that stands, w does not count.
    """

    def __init__(
        self, cameras: Sequence[Pinhole], matched: Sequence[Match], noise: Noise, flow: Flow | None = None
    ) -> None:
        pairs, middle = [[k, k + 1] for k in range(len(matched))], cameras[0].middle
        self.before = np.concatenate([np.zeros((0, 2)), *(one.before for one in matched)]) - middle
        self.now = (np.concatenate([np.zeros((0, 2)), *(one.now for one in matched)]) - middle).ravel()
        self.normal = np.tile(np.eye(2), (len(self.before), 1))  # along x and along y
        keys = [[turn_key(j), turn_key(k), zoom_key(j), zoom_key(k), LENS] for j, k in pairs]
        if noise.moves:
            own = [[place_key(j, moves=True), place_key(k, moves=True), NEAR] for j, k in pairs]
            keys = [turned + moved for turned, moved in zip(keys, own, strict=True)]
        keys = [[*mine, READOUT] for mine in keys] if noise.readout else keys
        self.rolled = np.zeros(len(self.now))
        if flow is not None:
            seen = [((j, one.before), (k, one.now)) for (j, k), one in zip(pairs, matched, strict=True)]
            ends = [[flow.late(px) * flow.of_background(i, px) for i, px in pair] for pair in seen]
            self.rolled = np.concatenate([np.zeros((0, 2)), *(now - before for before, now in ends)]).ravel()
        rows = [2 * len(one.now) for one in matched]
        super().__init__(len(cameras), noise, TOGETHER, np.full(len(self.now), noise.matches), pairs, rows, keys)

    def left(self, at: Unknowns) -> tuple[Array, tuple[Array, ...]]:
        """To where the points should be; by turns and log focal lengths, lens, places, nearness, readout."""
        turn = (at.turn[1:] @ at.turn[:-1].swapaxes(1, 2))[self.picture - 1]
        plane = undone(self.before / at.focal[self.picture[::2] - 1, None], at.bend)
        own = np.repeat(np.concatenate((plane, np.ones((len(plane), 1))), axis=1), 2, axis=0)
        square, now = (own[:, :2] ** 2).sum(axis=1), at.turn[1:][self.picture - 1]
        apart = (now @ (at.place[:-1] - at.place[1:])[self.picture - 1][..., None])[..., 0]
        place = (turn @ own[..., None])[..., 0] + at.near * apart
        across, by_place, by_lens = _across(place, at.focal[self.picture], at.bend, self.normal)
        by_own = (by_place[:, None] @ turn)[:, 0]
        # of undoing the distortion, which moves a point along its distance from the middle
        outward = (by_own * own)[:, :2].sum(axis=1) / (1.0 + 3.0 * at.bend * square)
        by_zoom, by_lens = -outward * (1.0 + at.bend * square), by_lens - (outward * square)[:, None]
        slopes = [-np.cross(by_own, own), np.cross(by_place, place), by_zoom[:, None], across[:, None], by_lens]
        if self.moves:
            by_before = at.near * (by_place[:, None] @ now)[:, 0]
            slopes += [by_before, -by_before, (by_place * apart).sum(axis=1)[:, None]]
        slopes += [self.rolled[:, None]] if self.rolls else []
        return across - self.now + at.readout * self.rolled, tuple(slopes)


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
