"""Gradients through a linear problem, whose solution is a formula; where there is none, that is said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.dynamics import Surfaces
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.estimation.launcher import Launcher
from ballfg.factors.batch import Noise, Values
from ballfg.factors.graph import BallGraph
from ballfg.factors.linear.step import solve as solve_linear
from ballfg.factors.loss import Loss
from ballfg.factors.noise import Kicks, whitening_tensor
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import state_prior
from ballfg.learning.end_to_end.learnables import NoiseScales
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients, GaussNewtonFactors, NotAMinimum
from ballfg.learning.gradient.implicit import GaussNewtonGradient, ImplicitGradient, UnrolledGradient
from ballfg.learning.gradient.objective import BatchObjective
from tests.learning.estimates import NOISE, SETTINGS, STARTS, Estimates, ball, factors_of, measured, objective_of
from tests.learning.gradient.outer_loss import SPREAD, outer

GRAVITY = ball(gravity={"g": 9.81})
LINEAR = replace(SETTINGS, loss=Loss(), spin_loss=Loss(), label_loss=Loss())


def linear_estimates() -> Estimates:
    """A ball under gravity alone; its launcher tells the spin about the vertical, whatever the direction of flight."""
    embedding = SpinEmbedding(("sidespin",), {}, torch.tensor([[0.0, 0.0, 30.0]], dtype=torch.float64))
    tracks = [replace(t, labels={"sidespin": 2.0}) for t in measured(GRAVITY, STARTS[:1], (14,))]
    noise = NoiseScales(replace(NOISE, contact_tangential=0.0), learned=True)
    settings = replace(LINEAR, launcher=Launcher(embedding, 15.0))
    return Estimates(GRAVITY, tracks, settings, noise, surfaces=Surfaces(-100.0))


def least_squares(estimates: Estimates, coefficients: Sequence[Tensor]) -> Tensor:
    """(n 9,) the minimum as a dense least-squares solution in torch.

    Args: coefficients: g, the embedding's weight (3, 1), logs of the process noise (4,), of position and of spin noise.
    """
    g, weight, process, position, spin = coefficients
    (track,), settings = estimates.tracks, estimates.settings
    n, eye, rows, right = len(track), torch.eye(9, dtype=torch.float64), [], []

    def add(blocks: dict[int, Tensor], value: Tensor) -> None:
        size = next(iter(blocks.values())).shape[0]
        rows.append(torch.cat([blocks.get(i, torch.zeros(size, 9, dtype=torch.float64)) for i in range(n)], dim=1))
        right.append(value)

    sigma = torch.tensor(settings.position_noise, dtype=torch.float64) * position.exp()
    for i, measured_position in enumerate(torch.from_numpy(track.positions)):
        add({i: eye[:3] / sigma[:, None]}, measured_position / sigma)
    dt = np.diff(track.times)
    basis = torch.from_numpy(Kicks.none(n - 1).basis(dt))[:, :2]  # acceleration and spin: no contact, no hit
    density = torch.tensor([NOISE.acceleration, NOISE.spin], dtype=torch.float64) * process[:2].exp()
    whiten = whitening_tensor(torch.einsum("mqij,q->mij", basis, density.square()))
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    for i, h in enumerate(dt.tolist()):
        step = eye.clone()
        step[:3, 3:6] = h * eye[:3, :3]
        fall = torch.cat((h**2 / 2 * g * down, h * g * down, torch.zeros(3, dtype=torch.float64)))
        add({i: -whiten[i] @ step, i + 1: whiten[i]}, whiten[i] @ fall)
    wide = torch.tensor([5.0] * 3 + [settings.velocity_prior] * 3 + [2000.0] * 3, dtype=torch.float64)
    mean = torch.cat((torch.from_numpy(track.positions[0]), torch.zeros(6, dtype=torch.float64)))
    add({0: torch.diag(1 / wide)}, mean / wide)
    label = 15.0 * spin.exp()
    add({0: eye[6:] / label}, 100.0 * 2.0 * weight[:, 0] / label)
    matrix, scale = torch.cat(rows), SPREAD.repeat(n)
    q, r = torch.linalg.qr(matrix * scale)
    return scale * torch.linalg.solve_triangular(r, (q.T @ torch.cat(right))[:, None], upper=True)[:, 0]


@pytest.mark.parametrize("method", [ImplicitGradient(), GaussNewtonGradient()], ids=["implicit", "gauss-newton"])
def test_a_linear_problem_has_its_closed_form(method) -> None:
    """1e-9 of each parameter's gradient; without curvature the Gauss-Newton matrix is the Hessian."""
    estimates = linear_estimates()
    assert estimates.noise.names == ("acceleration", "spin", "contact_velocity", "contact_spin")
    embedding = estimates.settings.launcher.embedding
    leaves = [*GRAVITY.parameters(), embedding.weight, *estimates.noise.parameters()]
    dense = least_squares(estimates, leaves)
    assert float(((estimates.point() - dense.detach()) / SPREAD.repeat(14)).abs().max()) < 1e-8
    expected = torch.autograd.grad(outer(dense), leaves)
    point = estimates.attached(method, leaves)
    found = torch.autograd.grad(outer(point), leaves)
    for a, b in zip(found, expected, strict=True):
        if b.shape == embedding.weight.shape:  # only the weight that tells the turn about the vertical acts linearly
            a, b = a[2], b[2]
        assert float(b.abs().max()) > 0.0
        print(f"{float((a - b).abs().max() / b.abs().max()):.0e} of {float(b.abs().max()):.1e}")  # shown by -s
        torch.testing.assert_close(a, b, rtol=0, atol=1e-8 * float(b.abs().max()))


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
