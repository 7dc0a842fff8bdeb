"""Searches in lockstep: each ends where it ends by itself, and costly kinds of one sort are evaluated in one call."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.factors.batch import Values
from ballfg.factors.dynamics import FlightFactors
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt, Linearization, Search, run
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.lockstep import linearize_together, run_together
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


def questions(problems: list[tuple[BallGraph, Values]]) -> list[Linearization]:
    return [Linearization(graph, values) for graph, values in problems]


@pytest.mark.parametrize("device", [None, torch.device("cpu")])
def test_together_as_by_itself(problems, device) -> None:
    """To rounding, in as many iterations; searches that end early do not disturb the others."""
    optimizer = LevenbergMarquardt(tolerance=1e-9)
    alone = [optimizer.minimize(graph, values) for graph, values in problems]
    together = run_together([optimizer.search(graph, values) for graph, values in problems], device)
    assert len({minimum.iterations for minimum in alone}) > 1
    for one, other in zip(alone, together, strict=True):
        assert one.convergence is other.convergence is Convergence.CONVERGED
        # the last steps are rounding: another order of the same sums may ask for one more
        assert one.iterations == other.iterations or device is not None
        assert one.error == pytest.approx(other.error, rel=1e-10)
        near = 1e-9 if device is None else 1e-7  # rad/s; the spin is known to 1
        np.testing.assert_allclose(other.values.states, one.values.states, rtol=1e-9, atol=near)
        np.testing.assert_allclose(other.values.coefficients, one.values.coefficients, rtol=1e-9)


def test_linearised_together_as_by_itself(problems) -> None:
    for answer, (graph, values) in zip(linearize_together(questions(problems)), problems, strict=True):
        for rows, expected in zip(answer, graph.linearize(values), strict=True):
            np.testing.assert_array_equal(rows.variables, expected.variables)
            assert rows.loss == expected.loss
            np.testing.assert_allclose(rows.residual, expected.residual, rtol=1e-12, atol=1e-12)
            for block, wanted in zip(rows.jacobians, expected.jacobians, strict=True):
                np.testing.assert_allclose(block, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


def test_one_call_a_sort(problems, monkeypatch) -> None:
    sizes = []
    propagate = FlightFactors.propagate
    monkeypatch.setattr(FlightFactors, "propagate", lambda kind, *a: sizes.append(len(kind)) or propagate(kind, *a))
    linearize_together(questions(problems))
    assert sizes == [7 + 13 + 2 + 10]


def test_models_are_not_mixed(model, augmented) -> None:
    """Nor embeddings: two launchers whose settings mean different things, in one call."""
    light, heavy = (SpinEmbedding(("topspin",), {}, torch.tensor([[0.0, s, 0.0]])) for s in (10.0, 90.0))
    values = Values(np.ones((1, 9)), np.zeros(0))
    graphs = [
        BallGraph((LauncherSpinFactors(np.array([0]), np.ones((1, 1)), embedding, np.ones((1, 3))),))
        for embedding in (light, heavy)
    ]
    answers = linearize_together([Linearization(graph, values) for graph in graphs])
    for (rows,), graph in zip(answers, graphs, strict=True):
        np.testing.assert_array_equal(rows.residual, graph.linearize(values)[0].residual)
    assert not np.allclose(answers[0][0].residual, answers[1][0].residual)
    other = AugmentedModel(model, tuple(reversed(augmented.names)))
    priors = [CoefficientPriorFactors(m, np.full(5, 0.1)) for m in (augmented, other)]
    assert priors[0].group != priors[1].group
    assert not np.allclose(priors[0].mean, priors[1].mean)


def test_results_come_in_order_whoever_ends_first() -> None:
    def counting(questions: int, name: str) -> Search[str]:
        for _ in range(questions):
            rows = yield Linearization(graph, values)
            assert len(rows) == 1
        return name

    graph, values = BallGraph((state_prior(0, np.zeros(9), np.ones(9)),)), Values(np.ones((1, 9)), np.zeros(0))
    names: Sequence[tuple[int, str]] = ((3, "slow"), (0, "at once"), (1, "quick"))
    assert run_together([counting(n, name) for n, name in names]) == ["slow", "at once", "quick"]
    assert run(counting(2, "alone")) == "alone"
    assert run(counting(0, "at once")) == "at once"
    assert run_together([]) == []


def test_an_error_inside_a_search_is_heard() -> None:
    def failing() -> Search[None]:
        yield Linearization(graph, values)
        raise FloatingPointError("lost")

    graph, values = BallGraph((state_prior(0, np.zeros(9), np.ones(9)),)), Values(np.ones((1, 9)), np.zeros(0))
    with pytest.raises(FloatingPointError, match="lost"):
        run_together([failing()])


@pytest.mark.parametrize("rough", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("bare", [False, True])
def test_a_search_goes_on_from_a_rough_minimum(problems, rough: float, bare: bool) -> None:
    """To the same point, in as many linear solutions; without the rough linearisation, one more at most."""
    optimizer = LevenbergMarquardt(tolerance=1e-6)
    for graph, values in problems:
        whole = optimizer.minimize(graph, values)
        begun = LevenbergMarquardt(tolerance=rough).minimize(graph, values)
        assert begun.iterations <= whole.iterations
        ended = run(optimizer.search(graph, begun.bare() if bare else begun))
        assert ended.convergence is Convergence.CONVERGED
        assert ended.distance < optimizer.tolerance
        assert abs(ended.iterations - whole.iterations) <= bare
        np.testing.assert_allclose(ended.values.states, whole.values.states, rtol=1e-6, atol=1e-6)
