"""Searches a second minimum at bounces, where friction may slide or grip.

While the ball slides, friction determines the direction of the slip only; once it grips, friction determines all of the
slip. A search that starts on one side may stop before it reaches the other. So a second search starts on the other side
and continues while it stays there; the lower minimum is the result. A spin label, if any, chooses the side.

A search of a whole long chain for every bounce would take a time that grows with the square of its length. There the
samples around a bounce decide first, and only spins that are clearly worse there are skipped.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.motion.arrays import bounced
from ballfg.estimation.smoother.settle import Solution
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values
from ballfg.factors.dynamics import model_width
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt
from ballfg.factors.prior import PriorFactors, spin_prior
from ballfg.state import SPIN, STATE_DIM, VELOCITY

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

SLIDES = 0.05
"""Slope of log(friction) by log(slip): 0 while the ball slides, 1 once it grips, with a gradual transition."""
SCALES = 2.0 ** np.arange(-4.0, 5.0)
"""Multiples of the estimated slip at which the ball may begin to slide."""
WELL_BEYOND = 1.5
"""Multiple of the slip at which the ball begins to slide, for a start."""
NEXT = 1.1
"""Multiple of a gripping slip: a minimum with a sliding ball has more."""
NUDGE = 1.01
LEAST_SLIP = 1e-3
"""m/s, below which a slip has no direction."""
TIE = 2.0
"""Of the objective, a log likelihood: a minimum that is higher by less has at least a seventh of the probability."""
RIVAL_APART = 2.5
"""Posterior standard deviations of the spin beyond which another spin is reported."""
LONG_CHAIN = 500
"""Number of states from which a bounce is first tested by itself."""
REACH = 8
"""Number of samples beyond those whose spin the bounce determines."""
SPIN_SPREAD = 60.0
"""rad/s, prior about the estimated spin of the first state in the test: it stands for all earlier samples."""


def with_other_spins(solution: Solution, model: BallModel, optimizer: LevenbergMarquardt) -> Solution:
    """The lowest of a solution and those where bounces grip instead of slide, or slide instead of grip."""
    least, bounces = optimizer.tolerance, bounces_of(solution)
    sides = other_sides(solution.minimum.values, bounces, model)
    for number, bounce in enumerate(bounces):
        side = next(sides)
        if side is None or not worth_a_search(solution, bounce, side, optimizer, TIE):
            continue
        minimum = optimizer.minimize(solution.graph, side.values, side.holds)
        if minimum.convergence is not Convergence.CONVERGED:
            continue
        found, lower = solution.minimum, minimum.error < solution.minimum.error - least
        tie = least < abs(minimum.error - found.error) < TIE
        rival = (found if lower else minimum).values.states[0, SPIN] if tie else solution.rival
        solution = replace(solution, minimum=minimum if lower else found, rival=rival)
        if lower:
            sides = other_sides(minimum.values, bounces[number + 1 :], model)
    return solution


def rival_note(rival: Array | None, state: Array, covariance: Array) -> tuple[str, ...]:
    """A note on another first spin that explains the track nearly as well, unless the first covariance includes it."""
    if rival is None:
        return ()
    spin = state[SPIN]
    apart = rival - spin
    if apart @ np.linalg.solve(covariance[SPIN, SPIN], apart) < RIVAL_APART**2:
        return ()
    one, other = ("({:.0f}, {:.0f}, {:.0f})".format(*value) for value in (spin, rival))
    return (f"two spins explain the track nearly as well: {one} and {other} rad/s at its start; a spin label decides",)


@dataclass(frozen=True)
class Bounce:
    """One bounce of a track: its interval, and the states whose spin it determines."""

    interval: int
    first: int
    last: int


def bounces_of(solution: Solution) -> list[Bounce]:
    """The bounces of a solution without a hit nearby, in their order.

    The spin before a bounce extends back to the previous bounce, hit or start, the spin after it to the next one.
    """
    segmentation, count = solution.events.segmentation, len(solution.minimum.values.states)
    broken = {*segmentation.hits.tolist(), *segmentation.restarts.tolist()}
    intervals = sorted({contact.interval for contact in solution.events.contacts})
    for rest in segmentation.rests:
        broken |= set(range(rest.first, rest.last + 1))
    cuts = np.array(sorted({-1, count - 1, *broken, *intervals}))
    return [
        Bounce(i, int(cuts[cuts < i][-1]) + 1, int(cuts[cuts > i][0]))
        for i in intervals
        if i not in broken and i < count - 1
    ]


@dataclass(frozen=True)
class OtherSide:
    """Start of a search beyond `edge`, m/s, the slip at which a ball begins to slide; it does so if `slides`."""

    values: Values
    interval: int
    edge: float
    slides: bool
    radius: float

    def holds(self, values: Values) -> bool:
        """True if the ball is still on this side of the edge."""
        slip = np.linalg.norm(_slip(values.states[self.interval], self.radius))
        return bool((slip >= self.edge) == self.slides)


def other_sides(values: Values, bounces: Sequence[Bounce], model: BallModel) -> Iterator[OtherSide | None]:
    """Starts at each bounce with another spin: rolling for sliding, or the reverse; None without slip or slide."""
    at = np.array([bounce.interval for bounce in bounces], dtype=np.int64)
    known = np.tile(values.coefficients[: model_width(model)], (len(at), 1))
    before = np.concatenate((values.states[at], known), axis=1)
    slip = _slip(before, model.radius)
    speed, sliding = np.linalg.norm(slip, axis=1), _slopes(before, slip, model) < SLIDES
    edge = SCALES[sliding.argmax(axis=1)]
    slides = edge > 1.0  # on the other side
    turned = _with_slip(before, slip, np.where(slides, WELL_BEYOND * edge, 0.0), model.radius)
    old, new = _bounced(np.stack((before, turned)), model)
    first, later = turned[:, SPIN] - before[:, SPIN], new[:, SPIN] - old[:, SPIN]
    there = (speed >= LEAST_SLIP) & sliding.any(axis=1)
    ends = speed * np.where(slides, NEXT, edge)
    for k, bounce in enumerate(bounces):
        if there[k]:
            states = values.states.copy()
            states[bounce.first : bounce.interval + 1, SPIN] += first[k]
            states[bounce.interval + 1 : bounce.last + 1, SPIN] += later[k]
            start = replace(values, states=states)
            yield OtherSide(start, bounce.interval, float(ends[k]), bool(slides[k]), model.radius)
        else:
            yield None


def worth_a_search(
    solution: Solution, bounce: Bounce, side: OtherSide, optimizer: LevenbergMarquardt, margin: float
) -> bool:
    """True if the minimum on the other side of a bounce is, nearby, another one and higher by less than a margin."""
    count = len(solution.minimum.values.states)
    if count < LONG_CHAIN or solution.minimum.step is None:
        return True
    first, last = max(0, bounce.first - REACH), min(count - 1, bounce.last + REACH)
    graph, begin = _around(solution, first, last), side.values.select(first, last + 1)
    holds = replace(side, interval=side.interval - first).holds
    there = optimizer.minimize(graph, begin, holds)
    if there.convergence is not Convergence.CONVERGED:
        return False
    here = optimizer.minimize(graph, solution.minimum.values.select(first, last + 1))
    higher = there.error - here.error
    return higher < margin and abs(higher) > optimizer.tolerance


def _around(solution: Solution, first: int, last: int) -> BallGraph:
    """The factors among some states; the whole chain's covariance is the prior of the coefficients."""
    values, step = solution.minimum.values, solution.minimum.step
    assert step is not None
    batches: list[FactorBatch] = []
    for batch in solution.graph.batches:
        states = batch.variables
        inside = ((states >= first) & (states <= last) | (states == COEFFICIENTS)).all(axis=1)
        inside &= (states != COEFFICIENTS).any(axis=1)
        if inside.any():
            part = batch.select(np.flatnonzero(inside))
            part.variables = np.where(part.variables == COEFFICIENTS, COEFFICIENTS, part.variables - first)
            batches.append(part)
    w, p = step.root.width, len(values.coefficients)
    if p:
        known = step.root.coefficients[:, 2 * w : 2 * w + p]
        batches.append(PriorFactors(np.array([COEFFICIENTS]), values.coefficients[None], known[None]))
    if first > 0:
        spread = np.full((1, 3), SPIN_SPREAD)
        batches.append(spin_prior(np.zeros(1, dtype=np.int64), values.states[first : first + 1, SPIN], spread))
    return BallGraph(tuple(batches))


def _slopes(before: Array, slip: Array, model: BallModel) -> Array:
    """Slopes of log(friction) by log(slip) at `SCALES` of the slips of some states."""
    scales = np.concatenate((SCALES, NUDGE * SCALES))
    rows = _with_slip(before[:, None], slip[:, None], scales, model.radius)
    kicks = (_bounced(rows, model) - before[:, None, :STATE_DIM])[..., VELOCITY][..., :2]
    at, beyond = np.split(np.maximum(np.linalg.norm(kicks, axis=-1), 1e-12), 2, axis=1)
    return np.asarray(np.log(beyond / at) / np.log(NUDGE))


def _slip(state: Array, radius: float) -> Array:
    """(.., 2) m/s, velocity of the ball's lowest point over a level surface, of states (.., 9) or longer."""
    across = np.stack((-state[..., SPIN.start + 1], state[..., SPIN.start]), axis=-1)
    return np.asarray(state[..., VELOCITY][..., :2] + radius * across)


def _with_slip(before: Array, slip: Array, scale: Array, radius: float) -> Array:
    """States (.., s) with multiples of their slip (.., 2), by another spin."""
    more = (scale - 1.0)[..., None] * slip / radius
    changed = np.array(np.broadcast_to(before, (*more.shape[:-1], before.shape[-1])))
    changed[..., SPIN.start] += more[..., 1]
    changed[..., SPIN.start + 1] -= more[..., 0]
    return changed


def _bounced(rows: Array, model: BallModel) -> Array:
    return bounced(model, rows.reshape(-1, rows.shape[-1]))[:, :STATE_DIM].reshape(*rows.shape[:-1], STATE_DIM)
