"""The graph of a camera that stands at one place, turns and zooms, solved with GTSAM.

Unknowns are the place (Point3) of a shot, its lens, how far each line is off in all pictures, and of each picture the
rotation (Rot3) and the logarithm of the focal length. Measurements are the ridges of the court's lines in each picture,
across the lines, and background points that were matched between neighbouring pictures: a turn and a zoom about one
place is a homography. Each residual r has Cauchy's loss, s^2 log(1 + (r / s)^2), as the square of a residual of that
size, so that the graph's least squares is the robust problem itself. The noise is that which the residuals show; of
many that err together the loss counts less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import gtsam
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.broadcast.background import Match
from ballfg.vision.broadcast.lines import Ridges, bending, slopes
from ballfg.vision.broadcast.pinhole import Pinhole

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


def solve(cameras: Sequence[Pinhole], seen: Sequence[Ridges | None], matched: Sequence[Match]) -> Solved:
    """The most probable cameras of a shot, and the noise with which the measurements are most probable.

    Args:
        cameras: first values, all at about one place.  seen: ridges of each picture, None where they do not count.
        matched: background of each picture with that of the one before, one less than cameras.
    """
    count = max((len(lines.asked) for lines in seen if lines is not None), default=1)
    first = gtsam.Values()
    first.insert(PLACE, gtsam.Point3(np.median([one.place for one in cameras], axis=0)))
    first.insert(LENS, np.zeros(1))
    first.insert(LINES, np.zeros(count))
    for k, one in enumerate(cameras):
        first.insert(_turn(k), gtsam.Rot3(one.turn.T))
        first.insert(_zoom(k), np.array([np.log(one.focal)]))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(STEPS)
    found, noise = first, Noise(np.full(count, RIDGE_SIGMA), LINE_SIGMA, MATCH_SIGMA)
    for number in range(ROUNDS):
        settings.setRelativeErrorTol(ROUGH if number < ROUNDS - 1 else SETTLED)
        graph = _graph(cameras, seen, matched, first, noise)
        found = gtsam.LevenbergMarquardtOptimizer(graph, found, settings).optimize()
        marginals = gtsam.Marginals(graph, found)
        if number < ROUNDS - 1:
            noise = _noise(cameras, seen, matched, found, marginals, noise)
    solved, covariances = list[Pinhole](), list[Array]()
    for k, one in enumerate(cameras):
        solved.append(_camera(one, found, k))
        joint = marginals.jointMarginalCovariance(gtsam.KeyVector([_turn(k), PLACE, _zoom(k)]))
        keys = (_turn(k), PLACE, _zoom(k))
        covariances.append(np.block([[joint.at(a, b) for b in keys] for a in keys]))
    return Solved(tuple(solved), np.stack(covariances))


def _graph(
    cameras: Sequence[Pinhole],
    seen: Sequence[Ridges | None],
    matched: Sequence[Match],
    first: gtsam.Values,
    noise: Noise,
) -> gtsam.NonlinearFactorGraph:
    """The graph of a shot. Args: first: values about which the priors are."""
    graph, count = gtsam.NonlinearFactorGraph(), len(noise.ridges)
    wide = gtsam.noiseModel.Isotropic.Sigma(3, PLACE_SIGMA)
    graph.add(gtsam.PriorFactorPoint3(PLACE, first.atPoint3(PLACE), wide))
    graph.add(gtsam.PriorFactorVector(LENS, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, BEND_SIGMA)))
    graph.add(gtsam.PriorFactorVector(LINES, np.zeros(count), gtsam.noiseModel.Isotropic.Sigma(count, noise.lines)))
    wide = gtsam.noiseModel.Isotropic.Sigma(1, FOCAL_SIGMA)
    for k, (one, lines) in enumerate(zip(cameras, seen, strict=True)):
        graph.add(gtsam.PriorFactorVector(_zoom(k), first.atVector(_zoom(k)), wide))
        if lines is not None and len(lines.offset):
            graph.add(_court_factor(k, one, lines, noise.ridges))
        if k:
            graph.add(_match_factor(k, one, matched[k - 1], noise.matches))
    return graph


def _noise(
    cameras: Sequence[Pinhole],
    seen: Sequence[Ridges | None],
    matched: Sequence[Match],
    found: gtsam.Values,
    marginals: gtsam.Marginals,
    noise: Noise,
) -> Noise:
    """The noise with which what is left is most probable, one step nearer.

    With Cauchy's loss its square is the mean of the squares, with the loss's weights. Lines are few: the posterior's
    variance counts too, as in the EM algorithm.
    """
    count, off = len(noise.ridges), found.atVector(LINES)
    solved = [_camera(one, found, k) for k, one in enumerate(cameras)]
    pairs = [(like, one, lines) for like, one, lines in zip(cameras, solved, seen, strict=True) if lines is not None]
    line = np.concatenate([np.zeros(0, dtype=np.int64), *(lines.line for *_, lines in pairs)])
    parts = [
        _across(one.project(lines.points) - like.project(lines.points), lines) + off[lines.line] - lines.offset
        for like, one, lines in pairs
    ]
    left = np.concatenate([np.zeros(0), *parts])
    square = _weighed(left, noise.ridges[line])
    ridges = np.bincount(line, square, minlength=count) / np.maximum(np.bincount(line, minlength=count), 1)
    apart = [
        after.project(after.place + before.directions(match.before) @ before.turn) - match.now
        for before, after, match in zip(solved[:-1], solved[1:], matched, strict=True)
    ]
    turned = _weighed(np.concatenate([np.zeros((0, 2)), *apart]), noise.matches)
    wide = (off**2 + np.diag(marginals.marginalCovariance(LINES))).sum() + LINES_KNOWN * LINE_SIGMA**2
    return Noise(
        np.maximum(np.sqrt(ridges), LEAST_SIGMA),
        float(np.sqrt(wide / (count + LINES_KNOWN))),
        max(float(np.sqrt(turned.sum() / max(turned.size, 1))), LEAST_SIGMA),
    )


def _weighed(left: Array, sigma: Array | float) -> Array:
    """The squares of residuals with the weights of Cauchy's loss."""
    return np.asarray(left**2 / (1.0 + (left / sigma / ROBUST) ** 2))


def _across(pixels: Array, lines: Ridges) -> Array:
    """(n,) px, of pixels (n, 2) across the lines."""
    return np.asarray((lines.normal * pixels).sum(axis=1))


def _turn(k: int) -> int:
    return int(gtsam.symbol("r", k))


def _zoom(k: int) -> int:
    return int(gtsam.symbol("f", k))


def _camera(like: Pinhole, values: gtsam.Values, k: int) -> Pinhole:
    turn, zoom = values.atRot3(_turn(k)).matrix().T, values.atVector(_zoom(k))[0]
    place, bend = np.asarray(values.atPoint3(PLACE)), float(values.atVector(LENS)[0])
    return replace(like, turn=turn, place=place, focal=float(np.exp(zoom)), bend=bend)


def _court_factor(k: int, like: Pinhole, lines: Ridges, noise: Array) -> gtsam.CustomFactor:
    """The ridges of picture k, whose cameras differ from `like` little. Args: noise: (l,) px, of each line's."""
    sigma = noise[lines.line]
    own_line = np.eye(len(lines.asked))[lines.line]
    seen = _across(like.project(lines.points), lines) + lines.offset

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        one = _camera(like, values, k)
        off = values.atVector(LINES)[lines.line]
        left, scale = _robust((_across(one.project(lines.points), lines) + off - seen) / sigma)
        if H is not None:
            scale = scale / sigma
            rows = scale[:, None] * np.einsum("na,nab->nb", lines.normal, slopes(one, lines.points)[1])
            for place, part in enumerate((slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 8))):
                H[place] = np.asfortranarray(rows[:, part])
            H[4] = np.asfortranarray(scale[:, None] * own_line)
        return left

    shared = gtsam.noiseModel.Isotropic.Sigma(len(sigma), np.sqrt(SHARED))
    return gtsam.CustomFactor(shared, gtsam.KeyVector([_turn(k), PLACE, _zoom(k), LENS, LINES]), error)


def _match_factor(k: int, like: Pinhole, match: Match, sigma: float) -> gtsam.CustomFactor:
    """The background of picture k, where that of picture k - 1 turns to: of a direction d, R_k^T R_(k-1) d."""
    keys = [_turn(k - 1), _turn(k), _zoom(k - 1), _zoom(k), LENS]

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        first, second = _camera(like, values, k - 1), _camera(like, values, k)
        own = first.directions(match.before)
        points = second.place + own @ first.turn
        left, scale = _robust(((second.project(points) - match.now) / sigma).ravel())
        if H is not None:
            slope = slopes(second, points)[1]
            by_own = -slope[..., 3:6] @ first.turn.T  # a place that moves with the point leaves the picture as it is
            none, (a, b, c) = np.zeros(len(own)), own.T
            cross = np.stack((none, -c, b, c, none, -a, -b, a, none), axis=1).reshape(-1, 3, 3)
            plane = own[:, :2]
            straight = np.linalg.inv(bending(plane, first.bend))
            square = (plane**2).sum(axis=1)[:, None]
            by_zoom = -straight @ (plane * (1.0 + first.bend * square))[..., None]
            by_lens = slope[..., 7:] - by_own[..., :2] @ straight @ (plane * square)[..., None]
            parts = (-by_own @ cross, slope[..., :3], by_own[..., :2] @ by_zoom, slope[..., 6:7], by_lens)
            for place, part in enumerate(parts):
                H[place] = np.asfortranarray(scale[:, None] * part.reshape(len(left), -1) / sigma)
        return left

    shared = gtsam.noiseModel.Isotropic.Sigma(2 * len(match.now), np.sqrt(TOGETHER))
    return gtsam.CustomFactor(shared, gtsam.KeyVector(keys), error)


def _robust(left: Array) -> tuple[Array, Array]:
    """Residuals whose squares are Cauchy's loss of the given ones, and their derivatives by these."""
    square = (left / ROBUST) ** 2
    size = ROBUST * np.sqrt(np.log1p(square))
    small = np.abs(left) < 1e-4
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(small, 1.0, np.abs(left) / ((1.0 + square) * size))
    return np.where(small, left, np.sign(left) * size), scale
