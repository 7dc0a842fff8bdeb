"""How a minimisation ends where the objective bends: it stays at the bend, and says so."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.factors.batch import FactorBatch, Values
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt


class Bent(FactorBatch):
    """Residuals v / sigma of a state v (9,), and 1 + left |x| or 1 + right x of its first number, by its sign."""

    def __init__(self, sigma: float, left: float, right: float) -> None:
        super().__init__(np.array([[0]]), 10)
        self.sigma, self.left, self.right = sigma, left, right

    def compute(self, rows, inputs):
        (state,) = inputs
        x = state[:, 0]
        slope = np.where(x < 0.0, -self.left, self.right)
        jacobian = np.zeros((len(x), 10, 9))
        jacobian[:, :9] = np.eye(9) / self.sigma
        jacobian[:, 9, 0] = slope
        return np.concatenate((state / self.sigma, (1.0 + slope * x)[:, None]), axis=1), (jacobian,)


@pytest.mark.parametrize(
    ("sigma", "left", "right", "ending"),
    [
        (1e-3, 0.3, 0.5, Convergence.AT_KINK),  # a whole step is shorter than a thousandth of a standard deviation
        (1.0, 0.3, 0.5, Convergence.STUCK),  # whole steps are long, and lead up on the other side
    ],
)
def test_the_minimum_is_at_the_bend(sigma: float, left: float, right: float, ending: Convergence) -> None:
    graph = BallGraph((Bent(sigma, left, right),))
    start = np.zeros((1, 9))
    start[0, 0] = 2e-4 * sigma
    minimum = LevenbergMarquardt().minimize(graph, Values(start, np.zeros(0)))
    assert minimum.convergence is ending
    assert abs(minimum.values.states[0, 0]) < 1e-3 * sigma
    assert minimum.error == pytest.approx(0.5, abs=1e-3)
    assert not minimum.values.states[0, 1:].any()


def test_without_a_bend_it_converges() -> None:
    graph = BallGraph((Bent(1.0, -0.4, 0.4),))
    minimum = LevenbergMarquardt().minimize(graph, Values(np.full((1, 9), 0.5), np.zeros(0)))
    assert minimum.convergence is Convergence.CONVERGED
    assert minimum.values.states[0, 0] == pytest.approx(-0.4 / 1.16, abs=1e-9)  # of x^2 + (1 + 0.4 x)^2


@pytest.mark.parametrize(("off", "ending"), [(5e-4, Convergence.AT_KINK), (0.5, Convergence.TOO_MANY_ITERATIONS)])
def test_at_the_iteration_limit_only_what_is_near_the_minimum_is_there(off: float, ending: Convergence) -> None:
    graph = BallGraph((Bent(1.0, -0.4, 0.4),))
    start = np.zeros((1, 9))
    start[0, 0] = -0.4 / 1.16 + off  # a posterior standard deviation is 0.93
    minimum = LevenbergMarquardt(max_iterations=0).minimize(graph, Values(start, np.zeros(0)))
    assert minimum.convergence is ending
    assert minimum.values.states[0, 0] == start[0, 0]


class OnCircle(FactorBatch):
    """Residuals of a point at an angle on a circle from a point at a distance of its centre; the angle is x, scaled."""

    def __init__(self, radius: float, distance: float) -> None:
        super().__init__(np.array([[0]]), 11)
        self.radius, self.distance = radius, distance

    def compute(self, rows, inputs):
        (state,) = inputs
        angle = state[:, 0] / self.radius
        residual = np.concatenate((state, np.zeros((len(state), 2))), axis=1)
        residual[:, 0] = 0.0
        residual[:, 9] = self.radius * np.cos(angle) - self.distance
        residual[:, 10] = self.radius * np.sin(angle)
        jacobian = np.zeros((len(state), 11, 9))
        jacobian[:, np.arange(1, 9), np.arange(1, 9)] = 1.0
        jacobian[:, 9, 0], jacobian[:, 10, 0] = -np.sin(angle), np.cos(angle)
        return residual, (jacobian,)


@pytest.mark.parametrize("bend", [0.1, 0.15, 0.3, 1.0, 1.6, 1.9])
def test_steps_that_are_too_long_or_too_short_do_not_creep(bend: float) -> None:
    """The objective bends `bend` times as much as its linear model says; the minimum is at zero.

    Whole steps would shrink the distance to it by |1 - bend| each: to a hundred-thousandth in 100 steps for 0.1.
    """
    graph, start = BallGraph((OnCircle(50.0, 50.0 * bend),)), np.full((1, 9), 0.5)
    minimum = LevenbergMarquardt().minimize(graph, Values(start, np.zeros(0)))
    assert minimum.convergence is Convergence.CONVERGED
    assert minimum.iterations <= 12
    assert abs(minimum.values.states[0, 0]) < 1e-4


class Valley(FactorBatch):
    """Rosenbrock's valley along y = x^2 of the first two numbers of a state v (9,), with a minimum at (1, 1)."""

    def __init__(self, steepness: float) -> None:
        super().__init__(np.array([[0]]), 9)
        self.steepness = steepness

    def compute(self, rows, inputs):
        (state,) = inputs
        x, y, residual = state[:, 0], state[:, 1], state.copy()
        residual[:, 0], residual[:, 1] = 1.0 - x, self.steepness * (y - x**2)
        jacobian = np.zeros((len(x), 9, 9))
        jacobian[:, np.arange(2, 9), np.arange(2, 9)] = 1.0
        jacobian[:, 0, 0] = -1.0
        jacobian[:, 1, 0], jacobian[:, 1, 1] = -2.0 * self.steepness * x, self.steepness
        return residual, (jacobian,)


@pytest.mark.parametrize("steepness", [10.0, 1e3, 1e5])
def test_a_step_bends_along_a_narrow_valley(steepness: float) -> None:
    """However narrow it is: a straight step would have to be the shorter, the steeper the sides are."""
    start = np.zeros((1, 9))
    start[0, :2] = -1.2, 1.44
    minimum = LevenbergMarquardt(max_iterations=5).minimize(BallGraph((Valley(steepness),)), Values(start, np.zeros(0)))
    assert minimum.convergence is Convergence.CONVERGED
    assert minimum.values.states[0, :2] == pytest.approx([1.0, 1.0], abs=1e-6)
