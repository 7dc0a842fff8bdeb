"""A factor graph over one track: its factors, its objective, and the loop that minimises it."""

import copy
import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballfg.factors.batch import FactorBatch, Rows, Values
from ballfg.factors.linear.covariance import Covariances, marginal_covariances
from ballfg.factors.linear.step import Step, solve


@dataclass(frozen=True)
class BallGraph:
    """Factors over n states and p shared coefficients.

    Attributes:
        batches: the factors; those of one sort are one object.
    """

    batches: tuple[FactorBatch, ...]

    def linearize(self, values: Values) -> list[Rows]:
        """All factors at a point, one call a batch; not finite where a trial step left all that a ball can do."""
        with np.errstate(over="ignore", invalid="ignore"):
            return [batch.linearize(values) for batch in self.batches if len(batch)]

    def error(self, values: Values) -> float:
        """The objective: sum of all losses; half the squared whitened residuals where none is robust."""
        return objective(self.linearize(values))


def objective(linearized: Sequence[Rows]) -> float:
    """Sum of all losses; infinite where a residual is not a number."""
    total = sum(rows.error() for rows in linearized)
    return total if np.isfinite(total) else np.inf


class Convergence(enum.Enum):
    """How a minimisation ended."""

    CONVERGED = "converged"
    AT_KINK = "no step reduces the objective: the minimum lies where a loss or the friction bends"
    STUCK = "no step reduces the objective further although the gradient is not zero"
    TOO_MANY_ITERATIONS = "the iteration limit was reached"
    NOT_FINITE = "the objective is not finite at the start"
    LEFT = "the search left where it was to stay"


@dataclass(frozen=True)
class Minimum:
    """Where Levenberg-Marquardt ended.

    Attributes:
        values: the point.
        error: objective there; after a last step without another linearisation, the one that the step promised.
        step: the last undamped linear solution, there or one step before: its triangle holds the covariances.
        convergence: why it stopped.
        iterations: number of linear solutions.
        linearized: the factors, linearised at the point or, where it is `beyond` them, one step before.
        beyond: whether the last step was taken without another linearisation.
        distance: about how far it is from the exact minimum, in posterior standard deviations; infinite if unknown.
        last: length of the last step that was taken, for a search that goes on; infinite if it says nothing.
    """

    values: Values
    error: float
    step: Step | None
    convergence: Convergence
    iterations: int
    linearized: Sequence[Rows] = ()
    beyond: bool = False
    distance: float = np.inf
    last: float = np.inf

    def bare(self) -> "Minimum":
        """Without the linearised factors, which take 1 kB a factor, for those who keep many."""
        return replace(self, linearized=(), beyond=True)


AT_KINK = 1e-3
"""Posterior standard deviations. A step this short that does not reduce the objective ends the search too: the minimum
lies where a loss or the friction bends."""
NEAR = 0.5
"""What a step promises when it is one posterior standard deviation long. Along shorter ones the objective is a parabola
well enough to say which share of the step is best."""
WHOLE = 0.5
"""A step that keeps more than this share of its promise is as good as the linear model can make it."""
SHORT = 1.5
"""A step that brings more than this multiple of its promise is too short: the objective bends half as much."""
ROUNDING = 1e-14
"""Of the objective, to which its sum is rounded: what a step brings says nothing where it promises less."""
RATE_MARGIN = 10.0
"""How many times slower than so far the lengths of the steps may fall for the next one to be left out."""
LONGEST = 10.0
"""Of a whole step, that is tried where it is too short."""
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

    def minimize(
        self, graph: BallGraph, start: Values | Minimum, within: Callable[[Values], bool] | None = None
    ) -> Minimum:
        """Minimise a graph's objective from a starting point.

        Each iteration tries the Gauss-Newton step; where it does not reduce the objective, lambda grows until a
        step does. The length of an undamped step in the metric of J^T J, |J d|, is the distance to the minimum in
        posterior standard deviations: free of units, and what `tolerance` bounds. When the lengths fall so quickly that
        the next step would be within the tolerance, the present one is the last.

        Args:
            graph: what is minimised.
            start: where from; a minimum found with a larger tolerance is gone on from.
            within: whether a point may be gone on from; the search ends as `LEFT` at one that may not.
        """
        found = (
            Minimum(start, np.inf, None, Convergence.CONVERGED, 0, beyond=True) if isinstance(start, Values) else start
        )
        known = None if found.beyond else found.linearized
        point = _Point(found.values, graph.linearize(found.values) if known is None else known)
        if not np.isfinite(point.error):
            return Minimum(point.values, point.error, None, Convergence.NOT_FINITE, 1, point.linearized)
        damping, growth, last = 0.0, 10.0, found.last
        for iteration in range(found.iterations + found.beyond, self.max_iterations + 1):
            if within is not None and not within(point.values):
                return point.minimum(None, Convergence.LEFT, iteration)
            again = known is not None and iteration == found.iterations
            step = found.step if again else solve(point.linearized, point.values, damping)
            length = np.sqrt(2 * abs(step.decrease)) if step is not None and damping == 0.0 else np.inf
            if step is not None and length < self.tolerance:
                return point.minimum(step, Convergence.CONVERGED, iteration, float(length), last)
            beyond = RATE_MARGIN * length * (length / last) if np.isfinite(last) else np.inf
            if step is not None and beyond < self.tolerance:
                return point.moved(step).minimum(step, Convergence.CONVERGED, iteration, float(beyond), float(length))
            trial = None if step is None else _tried(graph, point, step, damping)
            if step is not None and trial is not None and trial.error <= point.error * (1 + 1e-12):
                gain = _gain(point, trial, step)
                point, last = trial, length if WHOLE < gain < SHORT else np.inf
                damping, growth = damping * (0.1 if gain > WHOLE else 0.5), 10.0
                damping = 0.0 if damping < self.first_damping else damping
            elif length < AT_KINK:
                return point.minimum(step, Convergence.AT_KINK, iteration)
            elif damping > MOST_DAMPING:
                return point.minimum(solve(point.linearized, point.values), Convergence.STUCK, iteration)
            else:
                damping, growth = max(self.first_damping, growth * damping), 2.0 * growth
        return point.minimum(
            solve(point.linearized, point.values), Convergence.TOO_MANY_ITERATIONS, self.max_iterations
        )

    def covariances(self, graph: BallGraph, minimum: Minimum) -> Covariances | None:
        """Covariances at a minimum of a graph; None where they are not determined."""
        return None if minimum.step is None else marginal_covariances(minimum.step.root).definite()


class _Point:
    """Values, the graph linearised there or, where they are `beyond` it, one step before, and the objective."""

    def __init__(self, values: Values, linearized: Sequence[Rows]) -> None:
        self.values, self.linearized, self.error = values, linearized, objective(linearized)
        self.beyond = False

    def moved(self, step: Step) -> "_Point":
        """The point after a step that is not looked at, with the objective that it promises."""
        after = copy.copy(self)
        after.values, after.beyond = self.values.moved(step.states, step.coefficients), True
        after.error = self.error - step.decrease
        return after

    def minimum(
        self,
        step: Step | None,
        convergence: Convergence,
        iterations: int,
        distance: float = np.inf,
        last: float = np.inf,
    ) -> Minimum:
        """The end of a search here."""
        known = self.linearized, self.beyond
        return Minimum(self.values, self.error, step, convergence, iterations, *known, distance, last)


def _gain(before: _Point, after: _Point, step: Step) -> float:
    """What a step brought, as a share of its promise."""
    return (before.error - after.error) / max(step.decrease, np.finfo(float).tiny)


def _tried(graph: BallGraph, point: _Point, step: Step, damping: float) -> _Point:
    """Where a step leads: all of it, or a multiple where an undamped one brought far less or more than its promise.

    Where the objective bends r times as much along the step as the linear model says (friction between slip and grip
    does), the whole step brings (2 - r) of its promise and 1 / r of it is best. Whole steps then creep or diverge.
    """
    values = point.values.moved(step.states, step.coefficients)
    whole = _Point(values, graph.linearize(values))
    gain = _gain(point, whole, step)
    tells = gain <= WHOLE or (gain >= SHORT and step.decrease > ROUNDING * point.error)
    if damping > 0.0 or not tells or step.decrease > NEAR or not np.isfinite(whole.error):
        return whole
    share = 1.0 / max(2.0 - gain, 1.0 / LONGEST)
    values = point.values.moved(share * step.states, share * step.coefficients)
    nearer = _Point(values, graph.linearize(values))
    return nearer if nearer.error < min(point.error, whole.error) else whole
