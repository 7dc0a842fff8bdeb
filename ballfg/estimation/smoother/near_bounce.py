"""Decides from the samples around a bounce whether another spin is worth a search of a whole long chain.

A search of the whole chain for every bounce would take a time that grows with the square of its length. Only spins that
are clearly worse near the bounce are skipped; the others are searched as in a short track.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.estimation.smoother.solution import Solution
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt
from ballfg.factors.prior import PriorFactors, spin_prior
from ballfg.state import SPIN

if TYPE_CHECKING:
    from ballfg.estimation.smoother.grip import Bounce, OtherSide

LONG_CHAIN: Final = 500
"""Number of states from which a bounce is first tested by itself."""
REACH: Final = 8
"""Number of samples beyond those whose spin the bounce determines."""
SPIN_SPREAD: Final = 60.0
"""rad/s, prior about the estimated spin of the first state in the test: it stands for all earlier samples."""


def worth_a_search(
    solution: Solution, bounce: Bounce, side: OtherSide, optimizer: LevenbergMarquardt, margin: float
) -> bool:
    """True if the minimum on the other side of a bounce is, nearby, another one and higher by less than a margin.

    Args:
        solution: of the whole chain.
        bounce: in it.
        side: start of a search on the other side.
        optimizer: for both minima.
        margin: of the objective, a log likelihood.
    """
    count = len(solution.minimum.values.states)
    if count < LONG_CHAIN or solution.minimum.step is None:
        return True
    first, last = max(0, bounce.first - REACH), min(count - 1, bounce.last + REACH)
    graph, begin = _around(solution, first, last), _taken(side.values, first, last)
    holds = replace(side, interval=side.interval - first).holds
    there = optimizer.minimize(graph, begin, holds)
    if there.convergence is not Convergence.CONVERGED:
        return False
    here = optimizer.minimize(graph, _taken(solution.minimum.values, first, last))
    higher = there.error - here.error
    return higher < margin and abs(higher) > optimizer.tolerance


def _taken(values: Values, first: int, last: int) -> Values:
    inside = slice(first, last + 1)
    return replace(
        values, states=values.states[inside], biases=None if values.biases is None else values.biases[inside]
    )


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
