"""Estimates a long track exactly: first its pieces by themselves, then all of them together.

A first look at every piece fixes its events; its states and coefficients are initial values of the whole track.
Gauss-Newton steps of the whole track follow: each piece passes its information on its ends and the shared coefficients,
and gets their steps back. Memory holds some numbers a sample, and the matrices of the pieces in progress.
"""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.smoother.pieces import section
from ballfg.estimation.smoother.pieces.reduction import Chain, Ends, Point, Reduction, Response, solve_chain
from ballfg.estimation.smoother.settle import ROUGH
from ballfg.factors.batch import Values
from ballfg.factors.graph import AT_KINK, RATE_MARGIN, Convergence, objective
from ballfg.parallel.parts import in_parts
from ballfg.progress import doing
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.estimation.segmentation.result import Segmentation
    from ballfg.estimation.smoother.smoother import Smoother

T = TypeVar("T")
R = TypeVar("R")

PIECE: Final = 2000
"""Number of samples in a piece. Shorter ones repeat a larger share of their samples, longer ones take memory."""
OVERLAP: Final = 64
"""Number of further samples at both ends of a piece in its first look: as many as make the segmentation certain."""
MARGIN: Final = 8
"""Number of further samples at the ends of a section for velocities from line fits."""
TOGETHER: Final = 2
"""Number of pieces in one task of a process."""
REACH: Final = 128
"""Number of states at either end of a section that follow the end at once."""
ROUNDS: Final = 30
"""Largest number of Gauss-Newton steps of the whole track; usual are six, the later ones of a few sections."""
LEAST_SHARE: Final = 0.25  # of a step


@dataclass(frozen=True)
class Told:
    """The information of a section, linearised at a point.

    Attributes:
        values: the point.  error: of the section's factors.
        inner: predicted decrease of the error by the inner states alone.
        ends: information on the ends and the coefficients.  response: dependence of its states on these.
    """

    values: Values
    error: float
    inner: float
    ends: Ends
    response: Response

    def length(self, step: Point) -> float:
        """Length of a step of the whole section, in posterior standard deviations."""
        return float(np.sqrt(2.0 * self.inner + (self.ends.change(step) ** 2).sum()))

    def promised(self, step: Point) -> float:
        """The error after a step of the whole section, predicted by the linear problem."""
        y = self.ends.y
        return self.error - self.inner - 0.5 * float((y**2).sum() - ((y - self.ends.change(step)) ** 2).sum())


@dataclass(frozen=True)
class Joined:
    """All sections at the minimum of the whole track.

    Attributes:
        segmentation: of the whole track.  cuts: (k + 1,) first samples of the sections, and the track's last.
        rival: another first spin, or None.  states: the sections, one step before the minimum.
        chain: that step, with the covariances.  error: the objective after it.
        convergence, rounds: reason for the end of the search, and number of its linear solutions.
    """

    segmentation: "Segmentation"
    cuts: Sequence[int]
    rival: Array | None
    states: Sequence[section.State]
    chain: Chain
    error: float
    convergence: Convergence
    rounds: int


def told_by(smoother: "Smoother", state: section.State) -> Told:
    """The information of a section at its present values."""
    own = state.section.own(smoother.problem(state.section.track, state.section.segmentation))
    rows = state.section.linearized(own, state.values)
    found = Reduction(rows, state.values)
    return Told(state.values, objective(rows), found.inner, found.ends, found.response(REACH))


def joined_minimum(smoother: "Smoother", track: Track, length: int | None = None) -> Joined | None:
    """The minimum of a prepared track, by sections of about `length` samples; None if a piece has none."""
    rough = copy.copy(smoother)
    rough.optimizer = replace(smoother.optimizer, tolerance=max(ROUGH, smoother.optimizer.tolerance))
    bounds = section.bounds_of(len(track), length or PIECE, OVERLAP)
    parts = [(begin, section.part_of(track, begin, end)) for begin, end in bounds]
    looks = [one for one in watched(partial(section.look, rough), parts, "looked at") if one is not None]
    if len(looks) < len(parts):
        return None
    inner = [section.cut_between(*pair) for pair in pairwise(looks)]
    events = section.joined(looks, [0, *inner, len(track)])
    cuts = [0, *inner, len(track) - 1]
    states = [
        section.State(section.section_of(track, events, one, first, last, MARGIN), one.select(first, last + 1))
        for one, first, last in zip(looks, cuts[:-1], cuts[1:], strict=True)
    ]
    found = _search(smoother, states)
    return None if found is None else Joined(events, cuts, looks[0].rival, *found)


def _search(
    smoother: "Smoother", states: list[section.State]
) -> tuple[Sequence[section.State], Chain, float, Convergence, int] | None:
    """Gauss-Newton steps of the whole track until those of all sections are shorter than the optimizer's tolerance.

    Lengths are distances to the minimum in posterior standard deviations, as in
    `ballfg.factors.graph.LevenbergMarquardt`. A section that is near enough keeps its linearisation point.
    """
    tolerance = smoother.optimizer.tolerance
    told = list(watched(partial(told_by, smoother), states, "joined, round 1"))
    problem = smoother.problem(states[0].section.track, states[0].section.segmentation)
    priors, anchor = section.prior_rows(problem, states[0].section, told[0].values), told[0].values.coefficients
    last, gone = np.full(len(states), np.inf), dict[int, tuple[Array, float]]()
    for number in range(1, ROUNDS + 1):
        points = [Point.of(one.values) for one in told]
        solved = solve_chain([one.ends for one in told], points, priors, anchor)
        if solved is None:
            return None
        chain = solved
        steps = [chain.target(k).since(point) for k, point in enumerate(points)]
        length = np.array([one.length(step) for one, step in zip(told, steps, strict=True)])
        # near enough are sections that need no step, or none after this one if lengths fall at the same rate
        rate = np.divide(length, last, out=np.full_like(length, np.inf), where=np.isfinite(last))
        near = (length < tolerance) | (RATE_MARGIN * length * rate < tolerance)
        if near.all() or number == ROUNDS:
            break
        moving = np.flatnonzero(~near).tolist()
        inside = {k: told[k].response.steps(steps[k]) for k in moving}
        gone = {k: (step, share_of(step, *gone.get(k, (step, 1.0)))) for k, step in inside.items()}
        tasks = [
            section.State(states[k].section, told[k].values.retract(share * step, share * steps[k].coefficients))
            for k, (step, share) in gone.items()
        ]
        results = watched(partial(told_by, smoother), tasks, f"joined, round {number + 1}")
        for k, one in zip(moving, results, strict=True):
            told[k] = one
        last[moving] = length[moving]
    error = sum(one.promised(step) for one, step in zip(told, steps, strict=True))
    way = chain.coefficients - anchor
    error += objective([replace(rows, residual=rows.residual + rows.jacobians[0] @ way) for rows in priors])
    there = [section.State(state.section, one.values) for state, one in zip(states, told, strict=True)]
    at_kink = Convergence.AT_KINK if (near | (length < AT_KINK)).all() else Convergence.TOO_MANY_ITERATIONS
    return there, chain, error, Convergence.CONVERGED if near.all() else at_kink, number


def share_of(step: Array, before: Array, share: float) -> float:
    """The share of a step (n, w) to go, after a share of the one before it, or the same one if it is the first.

    A whole step may be too long: where the friction bends, the next one then leads back. The secant of both steps, with
    all columns alike, says how long it should be (J. Barzilai, J. M. Borwein 1988).
    """
    size = np.abs(before).max(axis=0)
    alike = before / np.where(size > 0.0, size, np.inf) ** 2
    shortened = float((alike * (before - step)).sum())
    whole = share * float((alike * before).sum())
    return float(np.clip(whole / shortened, LEAST_SHARE, 1.0)) if shortened > 0.0 else 1.0


def watched(function: Callable[[T], R], parts: Sequence[T], what: str) -> Iterator[R]:
    """The results of parts; reports progress."""
    with doing(f"0 of {len(parts)} pieces {what}") as stage:
        for done, result in enumerate(in_parts(function, parts, TOGETHER), start=1):
            stage.text = f"{done} of {len(parts)} pieces {what}"
            yield result
