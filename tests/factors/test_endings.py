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
