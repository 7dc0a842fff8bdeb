"""A factor graph holds the factors of one track and its objective; Levenberg-Marquardt minimises it."""

import copy
import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from ballfg.arrays import Array
from ballfg.factors.batch import FactorBatch, Rows, Values
from ballfg.factors.linear.covariance import Covariances, marginal_covariances
from ballfg.factors.linear.step import Step, solve


@dataclass(frozen=True)
class BallGraph:
    """Factors over n states and p shared coefficients.

    Attributes:
        batches: the factors; those of one kind are one object.
    """

    batches: tuple[FactorBatch, ...]

    def linearize(self, values: Values) -> list[Rows]:
        """All factors at a point, one call a batch; not finite after a trial step to an impossible state."""
        with np.errstate(over="ignore", invalid="ignore"):
            return [batch.linearize(values) for batch in self.batches if len(batch)]

    def error(self, values: Values) -> float:
        """The objective: sum of all losses; half the squared whitened residuals without a robust loss."""
        return objective(self.linearize(values))


def objective(linearized: Sequence[Rows]) -> float:
    """Sum of all losses; infinite if a residual is not a number."""
    total = sum([rows.error() for rows in linearized])
    return total if np.isfinite(total) else np.inf


class Convergence(enum.Enum):
    """The reason why a minimisation ended."""

    CONVERGED = "converged"
    AT_KINK = "no step reduces the objective: the minimum lies where a loss or the friction bends"
    STUCK = "no step reduces the objective further although the gradient is not zero"
    TOO_MANY_ITERATIONS = "the iteration limit was reached"
    NOT_FINITE = "the objective is not finite at the start"
    LEFT = "the search left where it was to stay"


@dataclass(frozen=True)
class Minimum:
    """The result of a minimisation by Levenberg-Marquardt.

    Attributes:
        values: the point.
        error: objective there; the predicted one if the last step was taken without another linearisation.
        step: the last undamped linear solution, there or one step before, whose triangle gives the covariances.
        convergence: the reason for the end.  iterations: number of linear solutions.
        linearized: the factors, linearised at the point or, if it is `beyond` them, one step before.
        beyond: True if the last step was taken without another linearisation.
        distance: approximate distance to the exact minimum, in posterior standard deviations; infinite if unknown.
        last: length of the last step, for a continued search; infinite if unknown.
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
        """Without the linearised factors, which take 1 kB a factor, for callers that keep many."""
        return replace(self, linearized=(), beyond=True)


AT_KINK = 1e-3
"""Posterior standard deviations. A step this short that does not reduce the objective ends the search too: the minimum
lies at a kink of a loss or of the friction, or rounding hides it. At the iteration limit it is the minimum, too."""
WHOLE = 0.5
"""A step with more than this share of its predicted decrease is as good as the linear model allows."""
SHORT = 1.5
"""A step with more than this multiple of its predicted decrease is too short: the objective bends half as much."""
ROUNDING = 1e-14
"""Relative rounding of the objective: a smaller predicted decrease cannot be verified."""
RATE_MARGIN = 10.0
"""Factor by which the convergence may slow down, for the last step to be left out all the same."""
LONGEST = 10.0
"""Largest multiple of a whole step, for a step that is too short."""
SHARES = 5
"""Largest number of shares of a step that are tried."""
SMALLER = 0.1, 0.6
"""Least and largest share, as a share of the one before."""
MOST_DAMPING = 1e8
"""Marquardt's lambda at which a step is negligible."""


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Settings of the minimisation.

    Attributes:
        tolerance: the search ends when the distance to the minimum, in posterior standard deviations, is shorter.
        max_iterations: largest number of linear solutions.
        first_damping: Marquardt's lambda after a Gauss-Newton step failed. Small: a tight process noise makes the
            diagonal of J^T J large where the chain as a whole is free to move.
    """

    tolerance: float = 1e-5
    max_iterations: int = 60
    first_damping: float = 1e-8

    def minimize(
        self, graph: BallGraph, start: Values | Minimum, within: Callable[[Values], bool] | None = None
    ) -> Minimum:
        """Minimises a graph's objective from a starting point.

        Each iteration tries the Gauss-Newton step; if that does not reduce the objective, lambda grows until a step
        does. The length of an undamped step in the metric of J^T J, |J d|, is the distance to the minimum in posterior
        standard deviations: free of units, and bounded by `tolerance`. When the lengths fall so quickly that the next
        step would be within the tolerance, the present one is the last.

        Args:
            graph: the factors.
            start: values; the search continues from a minimum that was found with a larger tolerance.
            within: True for points from which the search may continue; at another one it ends as `LEFT`.
        """
        found = (
            Minimum(start, np.inf, None, Convergence.CONVERGED, 0, beyond=True) if isinstance(start, Values) else start
        )
        graph = BallGraph(tuple([batch.prepared() for batch in graph.batches]))
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
                return point.retract(step).minimum(step, Convergence.CONVERGED, iteration, float(beyond), float(length))
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
        step = solve(point.linearized, point.values)
        near = step is not None and np.sqrt(2 * abs(step.decrease)) < AT_KINK  # steps of the objective's own rounding
        ended = Convergence.AT_KINK if near else Convergence.TOO_MANY_ITERATIONS
        return point.minimum(step, ended, self.max_iterations)

    def covariances(self, graph: BallGraph, minimum: Minimum) -> Covariances | None:
        """Covariances at a minimum of a graph; None if they are undetermined."""
        return None if minimum.step is None else marginal_covariances(minimum.step.root).definite()


class _Point:
    """Values, the graph linearised there or, if they are `beyond` it, one step before, and the objective."""

    def __init__(self, values: Values, linearized: Sequence[Rows]) -> None:
        self.values, self.linearized, self.error = values, linearized, objective(linearized)
        self.beyond = False

    def moved(self, graph: BallGraph, states: Array, coefficients: Array) -> "_Point":
        """The point after a step, linearised."""
        values = self.values.retract(states, coefficients)
        return _Point(values, graph.linearize(values))

    def retract(self, step: Step) -> "_Point":
        """The point after a step without a linearisation, with the predicted objective."""
        after = copy.copy(self)
        after.values, after.beyond = self.values.retract(step.states, step.coefficients), True
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
        """The result of a search that ends at this point."""
        known = self.linearized, self.beyond
        return Minimum(self.values, self.error, step, convergence, iterations, *known, distance, last)


def _gain(before: _Point, after: _Point, step: Step) -> float:
    """The decrease by a step, as a share of its prediction."""
    return (before.error - after.error) / max(step.decrease, np.finfo(float).tiny)


def _tried(graph: BallGraph, point: _Point, step: Step, damping: float) -> _Point:
    """The point after a step, or near it if an undamped one gained far less or more than predicted."""
    whole = point.moved(graph, step.states, step.coefficients)
    gain = _gain(point, whole, step)
    if damping > 0.0 or step.decrease <= ROUNDING * point.error or not np.isfinite(whole.error):
        return whole
    if gain <= WHOLE:
        return _bent(graph, point, step, whole)
    if gain >= SHORT:  # of a parabola that bends (2 - gain) times as much
        longer = min(1.0 / max(2.0 - gain, np.finfo(float).tiny), LONGEST)
        return min(whole, point.moved(graph, longer * step.states, longer * step.coefficients), key=attrgetter("error"))
    return whole


def _bent(graph: BallGraph, point: _Point, step: Step, whole: _Point) -> _Point:
    """The lowest point near a path that leaves along a step and bends as the residuals do, for shorter ones by and by.

    The objective is a narrow valley where tight residuals are not linear: the place of a bounce is a product of time
    and velocity. A straight step leaves the valley, and Marquardt's damping, which holds each unknown by itself, leaves
    only small ones. What the linear model missed after a share of the step is therefore taken back by a second step.
    Source: M. K. Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear
        least-squares minimization", 2012 (geodesic acceleration, with the error itself for its second derivative).
    """
    share, straight, best = 1.0, whole, whole
    for _ in range(SHARES):
        enough = point.error - WHOLE * share * (2.0 - share) * step.decrease
        if straight.error > enough and np.isfinite(straight.error):
            best = min(best, _taken_back(graph, point, step, share, straight), key=attrgetter("error"))
        if best.error < enough:
            break
        share *= min(max(share / (2.0 * share - _gain(point, straight, step)), SMALLER[0]), SMALLER[1])
        straight = point.moved(graph, share * step.states, share * step.coefficients)
        best = min(best, straight, key=attrgetter("error"))
    return best


def _taken_back(graph: BallGraph, point: _Point, step: Step, share: float, there: _Point) -> _Point:
    """The point after a share of a step, and a second step for what the linear model missed on the way `there`."""
    missed = [
        replace(old, residual=new.residual - share * step.change_of(old))
        for old, new in zip(point.linearized, there.linearized, strict=True)
    ]
    back = solve(missed, point.values)
    if back is None:
        return there
    rest = share - 1.0  # the solution makes the whole step as well
    return point.moved(graph, back.states + rest * step.states, back.coefficients + rest * step.coefficients)
