"""Minimises the graphs of this package by GTSAM's Levenberg-Marquardt, with GTSAM's marginals."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from ballfg.factors.batch import Values
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY, from_gtsam, linear_graph, nonlinear_graph, to_gtsam
from ballfg.factors.graph import AT_KINK, BallGraph, Convergence, LevenbergMarquardt, Minimum, objective
from ballfg.factors.linear.covariance import Covariances
from ballfg.factors.linear.step import solve

LEAST_DAMPING = 1e-12
"""GTSAM divides its lambda by ten after each step; zero could not grow again."""
LEAST_CHANGE = 1e-15
"""Change of the error, relative and absolute, at which GTSAM stops: below double precision."""


@dataclass(frozen=True)
class GtsamLevenbergMarquardt(LevenbergMarquardt):
    """Settings of a minimisation by `gtsam.LevenbergMarquardtOptimizer`.

    GTSAM's tolerances bound the change of the error, which hardly relates to the distance to the minimum. So its
    iterations continue until that distance, as `LevenbergMarquardt` measures it, is within the tolerance. Near the
    minimum GTSAM converges linearly, because it leaves out the curvature of robust losses.

    Attributes:
        tolerance: the search ends when the distance to the minimum, in posterior standard deviations, is shorter.
        max_iterations: largest number of GTSAM's iterations.  first_damping: GTSAM's first lambda.
    """

    tolerance: float = 2e-6
    max_iterations: int = 300
    first_damping: float = 1e-5

    def minimize(
        self, graph: BallGraph, start: Values | Minimum, within: Callable[[Values], bool] | None = None
    ) -> Minimum:
        """Minimises a graph's objective from a starting point; arguments as for `LevenbergMarquardt`."""
        first, values = (0, start) if isinstance(start, Values) else (start.iterations, start.values)
        rows = graph.linearize(values)
        error = objective(rows)
        if not np.isfinite(error):
            return Minimum(values, error, None, Convergence.NOT_FINITE, 1, rows)
        optimizer = gtsam.LevenbergMarquardtOptimizer(nonlinear_graph(graph)[0], to_gtsam(values), self._parameters())
        iteration, lower = first, True
        while True:
            step = solve(rows, values)
            distance = np.inf if step is None else float(np.sqrt(2 * abs(step.decrease)))
            if within is not None and not within(values):
                ended = Convergence.LEFT
            elif distance < self.tolerance:
                ended = Convergence.CONVERGED
            elif not lower:
                ended = Convergence.AT_KINK if distance < AT_KINK else Convergence.STUCK
            elif iteration >= self.max_iterations:
                ended = Convergence.TOO_MANY_ITERATIONS
            else:
                before = optimizer.error()
                optimizer.iterate()
                iteration, lower = iteration + 1, optimizer.error() < before
                values = from_gtsam(optimizer.values())
                rows = graph.linearize(values)
                continue
            return Minimum(values, objective(rows), step, ended, iteration, rows, distance=distance)

    def _parameters(self) -> gtsam.LevenbergMarquardtParams:
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky refuses priors that are wide beside the noise
        parameters.setlambdaInitial(self.first_damping)
        parameters.setlambdaLowerBound(LEAST_DAMPING)
        parameters.setRelativeErrorTol(LEAST_CHANGE)
        parameters.setAbsoluteErrorTol(LEAST_CHANGE)
        return parameters

    def covariances(self, graph: BallGraph, minimum: Minimum) -> Covariances | None:
        """GTSAM's marginals at a minimum of a graph; None if they are undetermined."""
        if minimum.step is None:
            return None
        return Marginals(linear_graph(graph.linearize(minimum.values)), to_gtsam(minimum.values)).covariances()


class Marginals:
    """GTSAM's marginals of states and coefficients, by QR; `gtsam.Marginals` offers Python Cholesky only.

    Args: linear: factors, linearised at a minimum.  values: the minimum.

    Attributes: distance: to the minimum of the linearised problem, in posterior standard deviations.

    Raises: RuntimeError: GTSAM's, of a graph that leaves a variable undetermined.
    """

    def __init__(self, linear: gtsam.GaussianFactorGraph, values: gtsam.Values) -> None:
        self._values = values
        self._tree = linear.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(linear), gtsam.EliminateQR)
        step = self._tree.optimize()
        here = linear.error(gtsam.VectorValues.Zero(step))
        self.distance = float(np.sqrt(2.0 * max(here - linear.error(step), 0.0)))

    def covariances(self) -> Covariances | None:
        """Marginals of x0, x1, ... and of c0; None if they are undetermined in double precision."""
        keys: list[int] = []
        while self._values.exists(STATE_KEY + len(keys)):
            keys.append(STATE_KEY + len(keys))
        states = np.array([self._tree.marginalCovariance(key) for key in keys])
        shared, cross = np.zeros((0, 0)), np.zeros((*states.shape[:2], 0))
        if self._values.exists(COEFFICIENT_KEY):
            joint = [self._tree.jointMarginalCovariance([key, COEFFICIENT_KEY]) for key in keys]
            shared = self._tree.marginalCovariance(COEFFICIENT_KEY)
            cross = np.array([one.at(key, COEFFICIENT_KEY) for key, one in zip(keys, joint, strict=True)])
        return Covariances(states, shared, cross).definite()
