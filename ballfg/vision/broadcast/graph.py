"""The graph of a camera that turns and zooms at one place, or moves, solved with GTSAM.

Unknowns are the place (Point3) of a shot, its lens, how far each line is off in all pictures, and of each picture the
rotation (Rot3) and the logarithm of the focal length. Measurements are the ridges of the court's lines in each picture,
across the lines, and background points that were matched between neighbouring pictures: a turn and a zoom about one
place is a homography. The noise is that which the residuals show.

A camera that moves has a place in each picture, which walks at random from one to the next, and the background a
distance; how far it walks is what the pictures show. It moves if that is more probable, by Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import gtsam
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.broadcast.background import Match
from ballfg.vision.broadcast.lines import ROBUST, Ridges
from ballfg.vision.broadcast.measured import (
    LENS,
    LINES,
    NEAR,
    READOUT,
    Background,
    CourtLines,
    Flow,
    Noise,
    Unknowns,
    place_key,
    turn_key,
    zoom_key,
)
from ballfg.vision.broadcast.pinhole import Pinhole

RIDGE_SIGMA, MATCH_SIGMA = 0.1, 0.15
"""px, of a ridge's place and of a background point's motion, at first; then what the recording shows, line by line."""
LEAST_SIGMA: Final = 0.01  # px, of these
LINE_SIGMA, LINES_KNOWN = 0.05, 4.0
"""px, by which a line is off in all pictures, at first: it was painted so, or its net sags, or the ground beside it
moves it; then what the lines show, with this as that of so many lines more."""
ROUNDS: Final = 3  # in which the noise is found
STEPS, ROUGH, SETTLED = 30, 1e-3, 1e-5
"""Of the minimiser at most, and the relative change of the sum of squares that ends it, while the noise is looked for
and at last."""
PLACE_SIGMA, FOCAL_SIGMA, BEND_SIGMA, NEAR_SIGMA = 30.0, 1.0, 0.1, 0.1
"""m, and of the logarithm: priors about the first values, far wider than what the court tells. Of k1, about none:
lenses of broadcasts have up to 0.2. Of one over the background's distance, 1/m, about none."""
WALK, WALKS = 0.003, 2  # m, from one picture to the next, at first, of a camera that moves; rounds in which it is found
READOUTS: Final = 0.5
"""Of the time between pictures, prior standard deviation of the readout of a rolling shutter, about none."""
SURE: Final = 3.0
"""Logarithm of how much more probable it must be that a camera moves or that its shutter rolls: most do neither."""


@dataclass(frozen=True, eq=False)
class Problem:
    """First values of a shot's cameras, ridges of each picture, and matches of each with the one before it.

    `flow`: of what stands still, which a rolling shutter shows; None where it does not roll.
    """

    cameras: Sequence[Pinhole]
    seen: Sequence[Ridges | None]
    matched: Sequence[Match]
    flow: Flow | None = None

    @property
    def lines(self) -> int:
        """Number of the court's lines."""
        return max((len(one.asked) for one in self.seen if one is not None), default=1)

    def first(self, cameras: Sequence[Pinhole], *, moves: bool) -> gtsam.Values:
        """Values of cameras with one lens, at their places or, of a camera that stands, at the middle one."""
        values, middle = gtsam.Values(), np.median([one.place for one in cameras], axis=0)
        for k, one in enumerate(cameras):
            values.insert(turn_key(k), gtsam.Rot3(one.turn.T))
            values.insert(zoom_key(k), np.array([np.log(one.focal)]))
            if moves or k == 0:
                values.insert(place_key(k, moves), gtsam.Point3(one.place if moves else middle))
        values.insert(LENS, np.array([cameras[0].bend]))
        values.insert(LINES, np.zeros(self.lines))
        if moves:
            values.insert(NEAR, np.array([NEAR_SIGMA]))  # at 0 its derivative would vanish
        return values


@dataclass(frozen=True, eq=False)
class Fit:
    """The most probable values for a noise, and the graph that they solve."""

    problem: Problem
    noise: Noise
    court: CourtLines
    background: Background
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values

    @classmethod
    def of(cls, problem: Problem, start: gtsam.Values, noise: Noise, tolerance: float) -> Fit:
        """The fit from some values on. Args: tolerance: relative change of the sum of squares that ends it."""
        settings = gtsam.LevenbergMarquardtParams()
        settings.setMaxIterations(STEPS)
        settings.setRelativeErrorTol(tolerance)
        court = CourtLines(problem.cameras, problem.seen, noise, problem.flow)
        background = Background(problem.cameras, problem.matched, noise, problem.flow)
        graph = _graph(court, background, problem.first(problem.cameras, moves=noise.moves), noise)
        found = gtsam.LevenbergMarquardtOptimizer(graph, start, settings).optimize()
        return cls(problem, noise, court, background, graph, found)

    @cached_property
    def unknowns(self) -> Unknowns:
        """What was found."""
        return Unknowns.of(self.values, len(self.problem.cameras))

    @cached_property
    def marginals(self) -> gtsam.Marginals:
        """The covariances of all unknowns."""
        return gtsam.Marginals(self.graph, self.values)

    @property
    def cameras(self) -> tuple[Pinhole, ...]:
        """One a picture."""
        at = self.unknowns
        return tuple(
            replace(one, turn=at.turn[k], place=at.place[k], focal=float(at.focal[k]), bend=at.bend)
            for k, one in enumerate(self.problem.cameras)
        )

    def covariances(self) -> Array:
        """(n, 7, 7) of the cameras' turn (rad, in the camera's frame), place (m) and log focal length."""
        covariances = list[Array]()
        for k in range(len(self.problem.cameras)):
            keys = turn_key(k), place_key(k, self.noise.moves), zoom_key(k)
            joint = self.marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
            covariances.append(np.block([[joint.at(a, b) for b in keys] for a in keys]))
        return np.stack(covariances)

    def evidence(self) -> float:
        """Logarithm of the probability of the measurements, up to what all fits to them have with one noise of them.

        Laplace's approximation; of the priors only those count that a camera has which moves.
        """
        bayes = self.graph.linearize(self.values).eliminateSequential()
        half = sum(float(np.log(np.abs(np.diag(bayes.at(i).R()))).sum()) for i in range(bayes.size()))
        steps = 3.0 * (len(self.problem.cameras) - 1)
        priors = steps * np.log(self.noise.walk) + np.log(NEAR_SIGMA) if self.noise.moves else 0.0
        priors += np.log(self.noise.readout) if self.noise.readout else 0.0
        return -float(self.graph.error(self.values) + half + priors)


def solve(cameras: Sequence[Pinhole], seen: Sequence[Ridges | None], matched: Sequence[Match]) -> Fit:
    """The most probable cameras of a shot, and the noise with which the measurements are most probable.

    Args:
        cameras: first values, all at about one place.  seen: ridges of each picture, None where they do not count.
        matched: background of each picture with that of the one before, one less than cameras.
    """
    problem = Problem(cameras, seen, matched)
    noise = Noise(np.full(problem.lines, RIDGE_SIGMA), LINE_SIGMA, MATCH_SIGMA)
    start = problem.first(cameras, moves=False)
    for number in range(ROUNDS):
        fit = Fit.of(problem, start, noise, ROUGH if number < ROUNDS - 1 else SETTLED)
        if number < ROUNDS - 1:
            noise, start = _noise(fit), fit.values
    fit = _moving(fit) or fit
    return _rolling(fit) or fit


def _moving(stands: Fit) -> Fit | None:
    """The fit of a camera that moves; None if it is not more probable, with the noise of the one that stands."""
    walk, moves, cameras = WALK, stands, stands.problem.cameras
    far = np.ptp([one.place for one in cameras], axis=0).max() > 0.0  # it was followed from place to place
    start = stands.problem.first(cameras if far else stands.cameras, moves=True)
    for _ in range(WALKS):
        moves = Fit.of(stands.problem, start, replace(stands.noise, walk=walk), ROUGH)
        walk, start = _walk(moves), moves.values
    if moves.evidence() < stands.evidence() + SURE:
        return None
    for number in range(1, ROUNDS):
        noise = replace(_noise(moves), walk=walk)
        moves = Fit.of(stands.problem, moves.values, noise, ROUGH if number < ROUNDS - 1 else SETTLED)
        walk = _walk(moves) if number < ROUNDS - 1 else walk
    return moves


def _rolling(plain: Fit) -> Fit | None:
    """The fit of a camera whose rows are seen one after the other; None if it is not more probable."""
    problem = replace(plain.problem, flow=Flow(plain.cameras, plain.unknowns.near))
    start = gtsam.Values(plain.values)
    start.insert(READOUT, np.zeros(1))
    rolls = Fit.of(problem, start, replace(plain.noise, readout=READOUTS), SETTLED)
    possible = abs(rolls.unknowns.readout) < 1.0  # else it would read into the next picture
    return rolls if possible and rolls.evidence() > plain.evidence() + SURE else None


def _walk(fit: Fit) -> float:
    """m, from one picture to the next, with which the places are most probable, one step of the EM algorithm nearer."""
    places, marginals = fit.unknowns.place, fit.marginals
    square = float((np.diff(places, axis=0) ** 2).sum())
    for k in range(len(places) - 1):
        before, now = place_key(k, moves=True), place_key(k + 1, moves=True)
        joint = marginals.jointMarginalCovariance(gtsam.KeyVector([before, now]))
        square += np.trace(joint.at(before, before) + joint.at(now, now) - 2.0 * joint.at(before, now))
    return float(np.sqrt(square / (3 * (len(places) - 1))))


def _graph(court: CourtLines, background: Background, first: gtsam.Values, noise: Noise) -> gtsam.NonlinearFactorGraph:
    """The graph of a shot. Args: first: values about which the priors are."""
    graph, lines, model = gtsam.NonlinearFactorGraph(), len(noise.ridges), gtsam.noiseModel.Isotropic
    place = place_key(0, noise.moves)
    graph.add(gtsam.PriorFactorPoint3(place, first.atPoint3(place), model.Sigma(3, PLACE_SIGMA)))
    graph.add(gtsam.PriorFactorVector(LENS, np.zeros(1), model.Sigma(1, BEND_SIGMA)))
    graph.add(gtsam.PriorFactorVector(LINES, np.zeros(lines), model.Sigma(lines, noise.lines)))
    for k in range(court.count):
        graph.add(gtsam.PriorFactorVector(zoom_key(k), first.atVector(zoom_key(k)), model.Sigma(1, FOCAL_SIGMA)))
    if noise.readout:
        graph.add(gtsam.PriorFactorVector(READOUT, np.zeros(1), model.Sigma(1, noise.readout)))
    if noise.moves:
        graph.add(gtsam.PriorFactorVector(NEAR, np.zeros(1), model.Sigma(1, NEAR_SIGMA)))
        still, walk = gtsam.Point3(0.0, 0.0, 0.0), model.Sigma(3, noise.walk)
        for k in range(1, court.count):
            pair = place_key(k - 1, moves=True), place_key(k, moves=True)
            graph.add(gtsam.BetweenFactorPoint3(*pair, still, walk))
    for batch in (court, background):
        for number in range(len(batch.keys)):
            graph.add(batch.factor(number))
    return graph


def _noise(fit: Fit) -> Noise:
    """The noise of the measurements with which what is left is most probable, one step nearer.

    With Cauchy's loss its square is the mean of the squares, with the loss's weights. Lines are few: the posterior's
    variance counts too, as in the EM algorithm.
    """
    court, background, at = fit.court, fit.background, fit.unknowns
    count, line = len(fit.noise.ridges), court.line
    square = _weighed(court.left(at)[0], court.sigma)
    ridges = np.bincount(line, square, minlength=count) / np.maximum(np.bincount(line, minlength=count), 1)
    turned = _weighed(background.left(at)[0], background.sigma)
    wide = (at.off**2 + np.diag(fit.marginals.marginalCovariance(LINES))).sum() + LINES_KNOWN * LINE_SIGMA**2
    return Noise(
        np.maximum(np.sqrt(ridges), LEAST_SIGMA),
        float(np.sqrt(wide / (count + LINES_KNOWN))),
        max(float(np.sqrt(turned.sum() / max(turned.size, 1))), LEAST_SIGMA),
    )


def _weighed(left: Array, sigma: Array) -> Array:
    """The squares of residuals with the weights of Cauchy's loss."""
    return np.asarray(left**2 / (1.0 + (left / sigma / ROBUST) ** 2))
