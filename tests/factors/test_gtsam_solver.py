"""GTSAM's Levenberg-Marquardt in place of the package's own: the same minimum, the same ends, the same marginals."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.arrays import Array
from ballfg.factors.batch import FactorBatch, Values
from ballfg.factors.bridge import nonlinear_graph, to_gtsam
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt, Minimum
from ballfg.factors.gtsam_solver import GtsamLevenbergMarquardt, Marginals
from ballfg.factors.linear.step import solve
from ballfg.factors.loss import Loss
from ballfg.factors.prior import state_prior
from tests.factors.test_bridge import problem


class Logarithm(FactorBatch):
    """r = log(x) of the first coordinate: not a number below zero, where Gauss-Newton goes from beyond e."""

    def __init__(self) -> None:
        super().__init__(np.array([[0]]), 1)

    def compute(self, rows: object, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        jacobian = np.zeros((1, 1, 9))
        jacobian[0, 0, 0] = 1.0 / inputs[0][0, 0]
        return np.log(inputs[0][:, :1]), (jacobian,)


def logarithm(at: float) -> tuple[BallGraph, Values]:
    start = np.zeros((1, 9))
    start[0, 0] = at
    return BallGraph((Logarithm(), state_prior(0, np.zeros(9), np.full(9, 100.0)))), Values(start, np.zeros(0))


@pytest.mark.parametrize("coefficients", [False, True])
@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 2.0), Loss("cauchy", 3.0)])
def test_the_minimum_and_its_covariances_are_those_of_the_own_solver(loss: Loss, *, coefficients: bool) -> None:
    graph, start = problem(np.random.default_rng(7), loss=loss, coefficients=coefficients, outlier=True)
    own, other = LevenbergMarquardt(tolerance=1e-9), GtsamLevenbergMarquardt()
    ours, theirs = own.minimize(graph, start), other.minimize(graph, start)
    assert theirs.convergence is Convergence.CONVERGED
    assert theirs.distance < other.tolerance
    known, found = own.covariances(graph, ours), other.covariances(graph, theirs)
    assert known is not None
    assert found is not None
    sigmas = np.sqrt(np.diagonal(known.states, axis1=1, axis2=2))
    assert (np.abs(theirs.values.states - ours.values.states) / sigmas).max() < 1e-5
    assert (np.abs(found.states - known.states) / (sigmas[:, :, None] * sigmas[:, None, :])).max() < 1e-5
    assert found.coefficients.shape == known.coefficients.shape
    assert found.cross.shape == known.cross.shape
    shared = np.sqrt(np.diag(known.coefficients))
    away = np.abs(found.coefficients - known.coefficients) / np.outer(shared, shared)
    assert away.max(initial=0.0) < 1e-5
    assert (np.abs(found.cross - known.cross) / (sigmas[:, :, None] * shared)).max(initial=0.0) < 1e-5


def test_a_step_to_where_nothing_is_finite_is_shortened() -> None:
    graph, start = logarithm(5.0)
    with np.errstate(invalid="ignore"):
        assert not np.isfinite(graph.error(Values(start.states * (1 - np.log(5.0)), np.zeros(0))))
    found, own = GtsamLevenbergMarquardt().minimize(graph, start), LevenbergMarquardt().minimize(graph, start)
    assert found.convergence is Convergence.CONVERGED
    assert found.values.states[0, 0] == pytest.approx(own.values.states[0, 0], rel=1e-6)


def test_how_a_search_ends() -> None:
    graph, start = problem(np.random.default_rng(7))
    optimizer = GtsamLevenbergMarquardt()
    lost, _ = logarithm(5.0)
    nowhere = optimizer.minimize(lost, Values(-np.ones((1, 9)), np.zeros(0)))
    assert (nowhere.convergence, nowhere.step) == (Convergence.NOT_FINITE, None)
    assert optimizer.covariances(lost, nowhere) is None
    assert optimizer.minimize(graph, start, lambda _: False).convergence is Convergence.LEFT
    short = GtsamLevenbergMarquardt(max_iterations=1).minimize(graph, start)
    assert (short.convergence, short.iterations) == (Convergence.TOO_MANY_ITERATIONS, 1)
    whole = optimizer.minimize(graph, short)  # goes on, and counts on
    assert whole.convergence is Convergence.CONVERGED
    assert whole.iterations > 1
    exact = GtsamLevenbergMarquardt(tolerance=0.0).minimize(graph, whole)  # as far as rounding lets it
    assert exact.convergence is Convergence.AT_KINK
    assert exact.distance < 1e-5


def test_the_distance_is_that_of_the_linearised_problem() -> None:
    """From a point off the minimum, with squared losses, where both linearise alike."""
    graph, start = problem(np.random.default_rng(7))
    minimum = LevenbergMarquardt(tolerance=1e-9).minimize(graph, start)
    assert isinstance(minimum, Minimum)
    off = Values(minimum.values.states + 1e-4, minimum.values.coefficients)
    step = solve(graph.linearize(off), off)
    assert step is not None
    expected = np.sqrt(2.0 * step.decrease)
    values = to_gtsam(off)
    assert Marginals(nonlinear_graph(graph)[0].linearize(values), values).distance == pytest.approx(expected, rel=1e-6)
