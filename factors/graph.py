"""A factor graph over one track: its kinds of factors, its objective, and the loop that minimises it."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.factors.kind import Array, FactorKind, Rows, Values
from ballfg.factors.linear import Step, solve


@dataclass(frozen=True)
class BallGraph:
    """Factors over n states and p shared coefficients.

    Attributes:
        kinds: the factors, one object a kind.
    """

    kinds: tuple[FactorKind, ...]

    def linearize(self, values: Values) -> list[Rows]:
        """All kinds at a point, each in one batch."""
        return [kind.linearize(values) for kind in self.kinds if len(kind)]

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
    STUCK = "no step reduces the objective further although the gradient is not zero"
    TOO_MANY_ITERATIONS = "the iteration limit was reached"
    NOT_FINITE = "the objective is not finite at the start"


@dataclass(frozen=True)
class Minimum:
    """Where Levenberg-Marquardt ended.

    Attributes:
        values: the point.
        error: objective there.
        step: the undamped linear solution there: its Bayes net holds the covariances.
        convergence: why it stopped.
        iterations: number of linearisations.
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
MOST_DAMPING = 1e8
"""Marquardt's lambda at which a step is as good as none."""


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Settings of the minimisation.

    Attributes:
        tolerance: stop when the step that is left, measured in posterior standard deviations, is shorter.
        max_iterations: linearisations.
        first_damping: Marquardt's lambda after a Gauss-Newton step failed. Small: a tight process noise makes the
            diagonal of J^T J large where the chain as a whole is free to move.
    """

    tolerance: float = 1e-5
    max_iterations: int = 60
    first_damping: float = 1e-8

    def minimize(self, graph: BallGraph, values: Values) -> Minimum:
        """Minimise a graph's objective from a starting point.

        Each iteration tries the Gauss-Newton step; where it does not reduce the objective, lambda grows until a
        step does. The length of an undamped step in the metric of J^T J, |J d|, is the distance to the minimum in
        posterior standard deviations: free of units, and what `tolerance` bounds.
        """
        linearized = graph.linearize(values)
        error = objective(linearized)
        if not np.isfinite(error):
            return Minimum(values, error, None, Convergence.NOT_FINITE, 1)
        damping, growth = 0.0, 10.0
        for iteration in range(1, self.max_iterations + 1):
            step = _try_solve(linearized, values, damping)
            if step is not None and damping == 0.0 and np.sqrt(2 * abs(step.decrease)) < self.tolerance:
                return Minimum(values, error, step, Convergence.CONVERGED, iteration)
            moved = None if step is None else values.moved(step.states, step.coefficients)
            trial = [] if moved is None else graph.linearize(moved)
            trial_error = objective(trial) if moved is not None else np.inf
            if step is not None and damping == 0.0 and step.decrease < NEAR and np.isfinite(trial_error):
                share = _better_share(error - trial_error, step.decrease)
                if share < 1.0:
                    nearer = values.moved(share * step.states, share * step.coefficients)
                    linearized_nearer = graph.linearize(nearer)
                    if objective(linearized_nearer) < min(error, trial_error):
                        moved, trial, trial_error = nearer, linearized_nearer, objective(linearized_nearer)
            if step is not None and moved is not None and trial_error <= error * (1 + 1e-12):
                gain = (error - trial_error) / max(step.decrease, np.finfo(float).tiny)
                values, linearized, error = moved, trial, trial_error
                damping, growth = damping * (0.1 if gain > 0.5 else 0.5), 10.0
                damping = 0.0 if damping < self.first_damping else damping
            elif step is not None and damping == 0.0 and np.sqrt(2 * abs(step.decrease)) < AT_KINK:
                return Minimum(values, error, step, Convergence.CONVERGED, iteration)
            elif damping > MOST_DAMPING:
                return Minimum(values, error, _try_solve(linearized, values, 0.0), Convergence.STUCK, iteration)
            else:
                damping, growth = max(self.first_damping, growth * damping), 2.0 * growth
        final = _try_solve(linearized, values, 0.0)
        return Minimum(values, error, final, Convergence.TOO_MANY_ITERATIONS, self.max_iterations)


def _better_share(decrease: float, promised: float) -> float:
    """How much of a Gauss-Newton step to take, from what all of it brought: 1 where it kept half of its promise.

    Where the objective bends r times as much along the step as the linear model says (friction between slip and grip
    does), the whole step brings (2 - r) of its promise and 1 / r of it is best. Whole steps then creep or diverge.
    """
    gain = decrease / max(promised, np.finfo(float).tiny)
    return 1.0 if gain > 0.5 else 1.0 / (2.0 - gain)


def _try_solve(linearized: Sequence[Rows], values: Values, damping: float) -> Step | None:
    """The linear solution, or None where the system is singular."""
    try:
        step = solve(linearized, values, damping)
    except RuntimeError as error:  # GTSAM's text changed between versions; the word did not
        if "Indetermin" not in str(error):
            raise
        return None
    return step if np.isfinite(step.states).all() else None


__all__ = ["Array", "BallGraph", "Convergence", "LevenbergMarquardt", "Minimum", "objective"]
