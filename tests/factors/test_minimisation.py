"""The minimisation: where it ends, goes on, and is given up."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.factors.batch import Values
from ballfg.factors.dynamics import FlightFactors
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import CoefficientPriorFactors, spin_prior, state_prior

NOISE = ProcessNoise(acceleration=0.5, spin=10.0)
SIGMA = 0.003


def flight(model, length: int, seed: int) -> tuple[BallGraph, Values]:
    """A ball in the air, its positions measured, started from a guess."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.008, 0.012, length))
    positions = np.stack((4.0 * times, times, 1.0 + 2.0 * times - 4.9 * times**2), axis=1)
    positions += SIGMA * rng.standard_normal((length, 3))
    dt = np.diff(times)
    kinds = [
        PositionFactors(np.arange(length), positions, np.full((length, 3), SIGMA), Loss("huber", 1.5)),
        FlightFactors(model, np.arange(length - 1), dt, NOISE.flight(dt)),
        state_prior(0, np.zeros(9), np.array([5.0] * 3 + [20.0] * 3 + [2000.0] * 3)),
        spin_prior(np.array([0]), np.array([[0.0, 60.0, 0.0]]), np.full((1, 3), 20.0)),
    ]
    states = np.zeros((length, 9))
    states[:, :3], states[:, 3:6] = positions, (4.0, 1.0, 1.0)
    if isinstance(model, AugmentedModel):
        kinds.append(CoefficientPriorFactors(model, np.full(len(model.names), 0.1)))
        return BallGraph(tuple(kinds)), Values(states, kinds[-1].mean[0].copy())
    return BallGraph(tuple(kinds)), Values(states, np.zeros(0))


@pytest.fixture(params=["plain", "coefficients"])
def problems(request, model) -> list[tuple[BallGraph, Values]]:
    own = model if request.param == "plain" else AugmentedModel(model, ("flight.drag.k", "flight.magnus.k"))
    return [flight(own, length, seed) for seed, length in enumerate((8, 14, 3, 11))]


@pytest.mark.parametrize("rough", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("bare", [False, True])
def test_a_search_goes_on_from_a_rough_minimum(problems, rough: float, bare: bool) -> None:
    """To the same point, in as many linear solutions; without the rough linearisation, one more at most."""
    optimizer = LevenbergMarquardt(tolerance=1e-6)
    for graph, values in problems:
        whole = optimizer.minimize(graph, values)
        begun = LevenbergMarquardt(tolerance=rough).minimize(graph, values)
        assert begun.iterations <= whole.iterations
        ended = optimizer.minimize(graph, begun.bare() if bare else begun)
        assert ended.convergence is Convergence.CONVERGED
        assert ended.distance < optimizer.tolerance
        assert abs(ended.iterations - whole.iterations) <= bare
        np.testing.assert_allclose(ended.values.states, whole.values.states, rtol=1e-6, atol=1e-6)


def test_a_search_that_leaves_is_given_up(problems) -> None:
    """At the first point that it may not go on from; one that stays is as if nothing had watched it."""
    optimizer = LevenbergMarquardt(tolerance=1e-6)
    for graph, values in problems:
        passed: list[Values] = []
        free = optimizer.minimize(graph, values, lambda point, passed=passed: passed.append(point) is None)
        np.testing.assert_array_equal(free.values.states, optimizer.minimize(graph, values).values.states)
        least = min(graph.error(point) for point in passed)
        left = optimizer.minimize(graph, values, lambda point, graph=graph, least=least: graph.error(point) > least)
        assert left.convergence is Convergence.LEFT
        assert graph.error(left.values) == least
        first = optimizer.minimize(graph, values, lambda point: False)
        assert first.convergence is Convergence.LEFT
        assert first.step is None
        np.testing.assert_array_equal(first.values.states, values.states)
