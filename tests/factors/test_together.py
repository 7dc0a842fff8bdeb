"""Linear systems of many tracks solved together in torch, against each by itself in machine code."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.factors.batch import Values
from ballfg.factors.dynamics import FlightFactors
from ballfg.factors.graph import BallGraph, LinearSolution
from ballfg.factors.linear.covariance import SquareRootInformation, marginal_covariances
from ballfg.factors.linear.step import Root, Step
from ballfg.factors.linear.together import solve_together
from ballfg.factors.noise import ProcessNoise
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import coefficient_prior, state_prior

CPU = torch.device("cpu")
NOISE = ProcessNoise(acceleration=0.5, spin=10.0)


def problem(model, length: int, seed: int, damping: float = 0.0, *, known: bool = True) -> LinearSolution:
    """A flight at some point; where it is not `known`, nothing tells its velocity and spin."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.008, 0.012, length - 1)
    states = rng.standard_normal((length, 9)) * np.repeat((1.0, 5.0, 50.0), 3) + (0, 0, 1, 4, 1, 1, 0, 60, 0)
    kinds = [PositionFactors(np.arange(length), states[:, :3] + 0.003, np.full((length, 3), 0.003))]
    if length > 1:
        kinds.append(FlightFactors(model, np.arange(length - 1), dt, NOISE.flight(dt)))
    if known:
        kinds.append(state_prior(0, states[0] + 0.1, np.repeat((5.0, 20.0, 60.0), 3)))
    coefficients = np.zeros(0)
    if isinstance(model, AugmentedModel):
        coefficients = model.means().detach().numpy().copy()
        kinds.append(coefficient_prior(coefficients + 0.01, np.full(len(coefficients), 0.1)))
    values = Values(states, coefficients)
    return LinearSolution(BallGraph(tuple(kinds)).linearize(values), values, damping)


def distance(root: Root, one: Step, other: Step) -> float:
    """Between two steps in posterior standard deviations, |R (d - d')|."""
    w, p = root.width, len(one.coefficients)
    states, shared = one.states - other.states, one.coefficients - other.coefficients
    after = np.concatenate((states[1:], np.zeros((1, w))))
    rows = np.einsum("nij,nj->ni", root.states[..., :w], states)
    rows += np.einsum("nij,nj->ni", root.states[..., w : 2 * w], after)
    rows += root.states[..., 2 * w : 2 * w + p] @ shared
    return float(np.sqrt((rows**2).sum() + ((root.coefficients[:, 2 * w : 2 * w + p] @ shared) ** 2).sum()))


@pytest.fixture(params=["plain", "coefficients", "both"])
def problems(request, model, augmented) -> list[LinearSolution]:
    """Of many lengths, one state alone among them, some held back."""
    used = {"plain": [model], "coefficients": [augmented], "both": [model, augmented]}[request.param]
    lengths, dampings = (40, 7, 1, 2, 23), (0.0, 1e-6, 0.0, 10.0, 1e-2)
    return [problem(m, n, n, d) for n, d in zip(lengths, dampings, strict=True) for m in used]


def test_together_as_by_itself(problems) -> None:
    for one, other in zip((p.answer() for p in problems), solve_together(problems, CPU), strict=True):
        assert distance(one.root, one, other) < 1e-9
        assert other.decrease == pytest.approx(one.decrease, rel=1e-11)


def test_the_triangles_hold_the_same_covariances(problems) -> None:
    for one, other in zip((p.answer() for p in problems), solve_together(problems, CPU), strict=True):
        expected, found = marginal_covariances(one.root), marginal_covariances(other.root)
        sigmas = np.sqrt(np.diagonal(expected.states, axis1=1, axis2=2))
        scale = sigmas[:, :, None] * sigmas[:, None, :]
        np.testing.assert_allclose(found.states / scale, expected.states / scale, atol=1e-9)
        np.testing.assert_allclose(found.coefficients, expected.coefficients, rtol=1e-9)


def test_covariances_of_tracks_of_many_lengths_are_those_of_each(model) -> None:
    roots = [problem(model, length, length).answer().root for length in (7, 40, 1, 23)]
    found = SquareRootInformation(roots).covariances()
    assert found.states.shape[:2] == (4, 40)
    for k, root in enumerate(roots):
        alone = SquareRootInformation([root]).covariances()
        n = len(root.states)
        np.testing.assert_array_equal(found.states[k, :n], alone.states[0])
        np.testing.assert_array_equal(found.cross[k, :n], alone.cross[0])
        assert not found.states[k, n:].any()


def test_a_singular_system_has_no_step_and_spoils_no_other(model) -> None:
    given = [problem(model, 12, 0), problem(model, 1, 1, known=False), problem(model, 5, 2)]
    first, none, last = solve_together(given, CPU)
    assert none is None is given[1].answer()
    for index, found in ((0, first), (2, last)):
        expected = given[index].answer()
        assert distance(expected.root, expected, found) < 1e-9


def test_no_systems_no_steps() -> None:
    assert solve_together([], CPU) == []
