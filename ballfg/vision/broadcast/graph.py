"""The graph of a camera that stands at one place, turns and zooms, solved with GTSAM.

Unknowns are the place (Point3) of a shot, its lens, how far each line is off in all pictures, and of each picture the
rotation (Rot3) and the logarithm of the focal length. Measurements are the ridges of the court's lines in each picture,
across the lines, and background points that were matched between neighbouring pictures: a turn and a zoom about one
place is a homography. Each residual r has Cauchy's loss, s^2 log(1 + (r / s)^2), as the square of a residual of that
size, so that the graph's least squares is the robust problem itself.
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

RIDGE_SIGMA: Final = 0.2
"""px, of a ridge's place."""
LINE_SIGMA: Final = 0.08
"""px, by which a line is off in all pictures: it was painted so, or its net sags, or the ground beside it moves it."""
SHARED: Final = 4.0
"""Ridges of a line in a picture, and matches of neighbouring points, err together: the number that counts as one."""
MATCH_SIGMA: Final = 0.5
"""px, of a background point's motion."""
ROBUST: Final = 2.0
"""Scale of Cauchy's loss, in standard deviations."""
PLACE, LENS, LINES = gtsam.symbol("p", 0), gtsam.symbol("l", 0), gtsam.symbol("c", 0)
STEPS: Final = 30
PLACE_SIGMA, FOCAL_SIGMA, BEND_SIGMA = 30.0, 1.0, 0.1
"""m, and of the logarithm: priors about the first values, far wider than what the court tells. Of k1, about none:
lenses of broadcasts have up to 0.2."""


@dataclass(frozen=True, eq=False)
class Solved:
    """Cameras of a shot; covariances (n, 7, 7) of turn (rad, in the camera's frame), place (m), log focal length."""

    cameras: tuple[Pinhole, ...]
    covariances: Array


def solve(cameras: Sequence[Pinhole], seen: Sequence[Ridges | None], matched: Sequence[Match]) -> Solved:
    """The most probable cameras of a shot.

    Args:
        cameras: first values, all at about one place.  seen: ridges of each picture, None where they do not count.
        matched: background of each picture with that of the one before, one less than cameras.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    place = np.median([one.place for one in cameras], axis=0)
    values.insert(PLACE, gtsam.Point3(place))
    graph.add(gtsam.PriorFactorPoint3(PLACE, place, gtsam.noiseModel.Isotropic.Sigma(3, PLACE_SIGMA)))
    values.insert(LENS, np.zeros(1))
    graph.add(gtsam.PriorFactorVector(LENS, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, BEND_SIGMA)))
    count = max((len(lines.asked) for lines in seen if lines is not None), default=1)
    values.insert(LINES, np.zeros(count))
    graph.add(gtsam.PriorFactorVector(LINES, np.zeros(count), gtsam.noiseModel.Isotropic.Sigma(count, LINE_SIGMA)))
    wide = gtsam.noiseModel.Isotropic.Sigma(1, FOCAL_SIGMA)
    for k, one in enumerate(cameras):
        values.insert(_turn(k), gtsam.Rot3(one.turn.T))
        values.insert(_zoom(k), np.array([np.log(one.focal)]))
        graph.add(gtsam.PriorFactorVector(_zoom(k), np.array([np.log(one.focal)]), wide))
        lines = seen[k]
        if lines is not None and len(lines.offset):
            graph.add(_court_factor(k, one, lines))
        if k:
            graph.add(_match_factor(k, one, matched[k - 1]))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(STEPS)
    settings.setRelativeErrorTol(1e-9)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    marginals = gtsam.Marginals(graph, found)
    solved, covariances = list[Pinhole](), list[Array]()
    for k, one in enumerate(cameras):
        solved.append(_camera(one, found, k))
        joint = marginals.jointMarginalCovariance(gtsam.KeyVector([_turn(k), PLACE, _zoom(k)]))
        keys = (_turn(k), PLACE, _zoom(k))
        covariances.append(np.block([[joint.at(a, b) for b in keys] for a in keys]))
    return Solved(tuple(solved), np.stack(covariances))


def _turn(k: int) -> int:
    return int(gtsam.symbol("r", k))


def _zoom(k: int) -> int:
    return int(gtsam.symbol("f", k))


def _camera(like: Pinhole, values: gtsam.Values, k: int) -> Pinhole:
    turn, zoom = values.atRot3(_turn(k)).matrix().T, values.atVector(_zoom(k))[0]
    place, bend = np.asarray(values.atPoint3(PLACE)), float(values.atVector(LENS)[0])
    return replace(like, turn=turn, place=place, focal=float(np.exp(zoom)), bend=bend)


def _court_factor(k: int, like: Pinhole, lines: Ridges) -> gtsam.CustomFactor:
    """The ridges of picture k, whose cameras differ from `like` little."""
    sigma = RIDGE_SIGMA * np.sqrt(SHARED)
    target = (lines.normal * like.project(lines.points)).sum(axis=1) + lines.offset
    own_line = np.eye(len(lines.asked))[lines.line]

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        pixels, slope = slopes(_camera(like, values, k), lines.points)
        left = ((lines.normal * pixels).sum(axis=1) + values.atVector(LINES)[lines.line] - target) / sigma
        left, scale = _robust(left)
        if H is not None:
            rows = scale[:, None] * np.einsum("na,nab->nb", lines.normal, slope) / sigma
            for place, part in enumerate((slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 8))):
                H[place] = np.asfortranarray(rows[:, part])
            H[4] = np.asfortranarray(scale[:, None] * own_line / sigma)
        return left

    unit = gtsam.noiseModel.Unit.Create(len(target))
    return gtsam.CustomFactor(unit, gtsam.KeyVector([_turn(k), PLACE, _zoom(k), LENS, LINES]), error)


def _match_factor(k: int, like: Pinhole, match: Match) -> gtsam.CustomFactor:
    """The background of picture k, where that of picture k - 1 turns to: of a direction d, R_k^T R_(k-1) d."""
    sigma = MATCH_SIGMA * np.sqrt(SHARED)
    keys = [_turn(k - 1), _turn(k), _zoom(k - 1), _zoom(k), LENS]

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        first, second = _camera(like, values, k - 1), _camera(like, values, k)
        own = first.directions(match.before)
        pixels, slope = slopes(second, second.place + own @ first.turn)
        left, scale = _robust(((pixels - match.now) / sigma).ravel())
        if H is not None:
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

    unit = gtsam.noiseModel.Unit.Create(2 * len(match.now))
    return gtsam.CustomFactor(unit, gtsam.KeyVector(keys), error)


def _robust(left: Array) -> tuple[Array, Array]:
    """Residuals whose squares are Cauchy's loss of the given ones, and their derivatives by these."""
    square = (left / ROBUST) ** 2
    size = ROBUST * np.sqrt(np.log1p(square))
    small = np.abs(left) < 1e-4
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(small, 1.0, np.abs(left) / ((1.0 + square) * size))
    return np.where(small, left, np.sign(left) * size), scale
