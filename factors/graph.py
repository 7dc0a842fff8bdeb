"""A factor graph over one track: its factors, its objective, and the loop that minimises it."""

import enum
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ballfg.factors.batch import FactorBatch, Rows, Values
from ballfg.factors.linear.step import Step, solve


@dataclass(frozen=True)
class BallGraph:
    """Factors over n states and p shared coefficients.

    Attributes:
        batches: the factors; those of one sort are one object.
    """

    batches: tuple[FactorBatch, ...]

    def linearize(self, values: Values) -> list[Rows]:
        """All factors at a point, one call for each batch."""
        return [batch.linearize(values) for batch in self.batches if len(batch)]

    def error(self, values: Values) -> float:
        """The objective: sum of all losses; half the squared whitened residuals where none is robust."""
        return objective(self.linearize(values))


def objective(linearized: Sequence[Rows]) -> float:
    """Sum of all losses; infinite where a residual is not a number."""
    total = sum(rows.error() for rows in linearized)
    return total if np.isfinite(total) else np.inf


R = TypeVar("R")

Question = tuple[BallGraph, Values]
Search = Generator[Question, list[Rows], R]
"""A computation that asks for linearisations: it yields a graph and a point, and is sent the graph linearised there.
Several searches can so share a torch call (`ballfg.factors.lockstep`)."""


def run(search: Search[R]) -> R:
    """The result of one search, answered as it asks."""
    try:
        graph, values = next(search)
        while True:
            graph, values = search.send(graph.linearize(values))
    except StopIteration as end:
        return end.value


class Convergence(enum.Enum):
    """How a minimisation ended."""

    CONVERGED = "converged"
    AT_KINK = "no step reduces the objective: the minimum lies where a loss or the friction bends"
    STUCK = "no step reduces the objective further although the gradient is not zero"
    TOO_MANY_ITERATIONS = "the iteration limit was reached"
    NOT_FINITE = "the objective is not finite at the start"


@dataclass(frozen=True)
class Minimum:
    """Where Levenberg-Marquardt ended.

    Attributes:
        values: the point.
        error: objective there; after a last step without another linearisation, the one that the step promised.
        step: the last undamped linear solution, there or one step before: its Bayes net holds the covariances.
        convergence: why it stopped.
        iterations: number of linear solutions.
    """

    values: Values
    error: float
    step: Step | None
    convergence: Convergence
    iterations: int


AT_KINK = 1e-3
"""Posterior standard deviations. A step this short that does not reduce the objective ends the search too: the minimum
lies where a loss or the friction bends."""
NEAR = 0.5
"""What a step promises when it is one posterior standard deviation long. Along shorter ones the objective is a parabola
well enough to say which share of the step is best."""
WHOLE = 0.5
"""A step that keeps more than this share of its promise is as good as the linear model can make it."""
RATE_MARGIN = 10.0
"""How many times slower than so far the lengths of the steps may fall for the next one to be left out."""
MOST_DAMPING = 1e8
"""Marquardt's lambda at which a step is as good as none."""


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Settings of the minimisation.

    Attributes:
        tolerance: stop when the distance to the minimum, in posterior standard deviations, is shorter.
        max_iterations: linear solutions.
        first_damping: Marquardt's lambda after a Gauss-Newton step failed. Small: a tight process noise makes the
            diagonal of J^T J large where the chain as a whole is free to move.
    """

    tolerance: float = 1e-5
    max_iterations: int = 60
    first_damping: float = 1e-8

    def minimize(self, graph: BallGraph, values: Values) -> Minimum:
        """Minimise a graph's objective from a starting point; see `search`."""
        return run(self.search(graph, values))

    def search(self, graph: BallGraph, values: Values) -> Search[Minimum]:
        """Minimise a graph's objective from a starting point, asking for linearisations.

        Each iteration tries the Gauss-Newton step; where it does not reduce the objective, lambda grows until a
        step does. The length of an undamped step in the metric of J^T J, |J d|, is the distance to the minimum in
        posterior standard deviations: free of units, and what `tolerance` bounds. When the lengths fall so quickly that
        the next step would be within the tolerance, the present one is the last.
        """
        point = _Point(values, (yield graph, values))
        if not np.isfinite(point.error):
            return Minimum(values, point.error, None, Convergence.NOT_FINITE, 1)
        damping, growth, last = 0.0, 10.0, np.inf
        for iteration in range(1, self.max_iterations + 1):
            step = solve(point.linearized, point.values, damping)
            length = np.sqrt(2 * abs(step.decrease)) if step is not None and damping == 0.0 else np.inf
            if step is not None and length < self.tolerance:
                return Minimum(point.values, point.error, step, Convergence.CONVERGED, iteration)
            if step is not None and RATE_MARGIN * length * (length / last) < self.tolerance and np.isfinite(last):
                moved = point.values.moved(step.states, step.coefficients)
                return Minimum(moved, point.error - step.decrease, step, Convergence.CONVERGED, iteration)
            trial = None if step is None else (yield from _tried(graph, point, step, damping))
            if step is not None and trial is not None and trial.error <= point.error * (1 + 1e-12):
                gain = (point.error - trial.error) / max(step.decrease, np.finfo(float).tiny)
                point, last = trial, length if gain > WHOLE else np.inf
                damping, growth = damping * (0.1 if gain > WHOLE else 0.5), 10.0
                damping = 0.0 if damping < self.first_damping else damping
            elif length < AT_KINK:
                return Minimum(point.values, point.error, step, Convergence.AT_KINK, iteration)
            elif damping > MOST_DAMPING:
                final = solve(point.linearized, point.values)
                return Minimum(point.values, point.error, final, Convergence.STUCK, iteration)
            else:
                damping, growth = max(self.first_damping, growth * damping), 2.0 * growth
        final = solve(point.linearized, point.values)
        return Minimum(point.values, point.error, final, Convergence.TOO_MANY_ITERATIONS, self.max_iterations)


class _Point:
    """Values, the graph linearised there, the objective."""

    def __init__(self, values: Values, linearized: Sequence[Rows]) -> None:
        self.values, self.linearized, self.error = values, linearized, objective(linearized)


def _tried(graph: BallGraph, point: _Point, step: Step, damping: float) -> Search[_Point]:
    """Where a step leads: all of it, or a share where an undamped one brought less than half of its promise.

    Where the objective bends r times as much along the step as the linear model says (friction between slip and grip
    does), the whole step brings (2 - r) of its promise and 1 / r of it is best. Whole steps then creep or diverge.
    """
    values = point.values.moved(step.states, step.coefficients)
    whole = _Point(values, (yield graph, values))
    gain = (point.error - whole.error) / max(step.decrease, np.finfo(float).tiny)
    if damping > 0.0 or gain > WHOLE or step.decrease > NEAR or not np.isfinite(whole.error):
        return whole
    share = 1.0 / (2.0 - gain)
    values = point.values.moved(share * step.states, share * step.coefficients)
    nearer = _Point(values, (yield graph, values))
    return nearer if nearer.error < min(point.error, whole.error) else whole
