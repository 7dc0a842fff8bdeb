"""Where an estimate has no gradient, or the search for it fails, that is said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.factors.batch import Noise, Values
from ballfg.factors.graph import BallGraph
from ballfg.factors.linear.step import solve as solve_linear
from ballfg.factors.loss import Loss
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import state_prior
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients, GaussNewtonFactors, NotAMinimum
from ballfg.learning.gradient.implicit import GaussNewtonGradient, ImplicitGradient, UnrolledGradient
from ballfg.learning.gradient.objective import BatchObjective
from tests.learning.estimates import Estimates, factors_of, objective_of


def between(spread: float) -> tuple[BallGraph, Values]:
    """A position seen at +- `spread` standard deviations, by Cauchy's loss: zero is a minimum or a top."""
    states, sigma, loss = Values(np.zeros((1, 9)), np.zeros(0)), np.ones((1, 3)), Loss("cauchy", 1.0)
    seen = [PositionFactors(np.array([0]), np.full((1, 3), sign * spread), sigma, loss) for sign in (-1, 1)]
    return BallGraph((*seen, state_prior(0, np.zeros(9), np.full(9, 30.0)))), states


def backward(spreads: Sequence[float], max_iterations: int = 50) -> None:
    problems = [between(spread) for spread in spreads]
    objective = BatchObjective([g for g, _ in problems], [v for _, v in problems])
    roots = [solve_linear(graph.linearize(values), values).root for graph, values in problems]
    factors = GaussNewtonFactors(roots)
    solver = ConjugateGradients(factors, objective.layout.owners(), 1e-12, max_iterations)
    scale = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    point = ImplicitGradient()(
        lambda: objective.layout.pack([v for _, v in problems]),
        lambda at: objective.gradient(at, Noise(position=scale)),
        solver,
        [scale],
    )
    torch.autograd.grad((point * torch.arange(1.0, len(point) + 1, dtype=torch.float64)).sum(), [scale])


def test_a_top_has_no_gradient() -> None:
    backward([0.2, 0.3])
    with pytest.raises(NotAMinimum, match="objective of 1 tracks bends downwards") as caught:
        backward([0.2, 2.0, 0.3])
    assert caught.value.tracks == (1,)
    with pytest.raises(NotAMinimum) as caught:
        backward([2.0, 0.3, 3.0])
    assert set(caught.value.tracks) <= {0, 2}


def test_an_iteration_that_does_not_arrive_is_told() -> None:
    with pytest.raises(NotAMinimum, match="Hessian of 2 tracks could not be solved in 1 steps") as caught:
        backward([0.99, 0.98], max_iterations=1)
    assert caught.value.tracks == (0, 1)


def test_what_is_not_a_number_is_told(analytic: Estimates) -> None:
    """Not even an infinite right side goes by in silence, and the track is named."""
    found = analytic.solve()
    objective = objective_of(found)
    point = analytic.attached(ImplicitGradient(), list(analytic.model.parameters()))
    of_second = objective.layout.owners() == 1
    with pytest.raises(NotAMinimum) as caught:
        torch.autograd.grad((point * torch.where(of_second, torch.nan, 1.0)).sum(), list(analytic.model.parameters()))
    assert caught.value.tracks == (1,)


def test_a_solver_that_raises_is_heard(analytic: Estimates) -> None:
    solver = ConjugateGradients(factors_of(analytic.solve()), torch.zeros(0))

    def solve() -> Tensor:
        raise FloatingPointError("no minimum was found")

    for method in (ImplicitGradient(), GaussNewtonGradient(), UnrolledGradient()):
        with pytest.raises(FloatingPointError, match="no minimum was found"):
            method(solve, lambda at: at, solver, [])
