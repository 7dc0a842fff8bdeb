"""Gradients through estimates: against differences of problems that are solved anew, a closed form, and unrolling.

The problems have a bounce in each window, residuals of up to six standard deviations, Huber's and Cauchy's losses. What
is seen against differences is 1e-9 to 1e-7; 1e-6 is asked for. The estimator's Jacobian of a bounce takes the true rate
at the contact where the residual has that of the discrete flight: its minimum lies 1e-8 of a gradient beside the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.dynamics import Surfaces
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import build
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
from ballfg.learning.gradient.implicit import GaussNewtonGradient, GradientMethod, ImplicitGradient, UnrolledGradient
from ballfg.learning.gradient.objective import BatchObjective
from tests.learning.estimates import (
    NOISE,
    SETTINGS,
    STARTS,
    Estimates,
    ball,
    directional,
    factors_of,
    launcher,
    measured,
    objective_of,
    usual_ball,
)

SAME = 1e-6
TRUTH = ball(gravity={}, drag={"k": 0.15}, magnus={"k": 0.004}, restitution={"e": 0.88}, friction={"mu": 0.25})
SPREAD = torch.tensor([1e-3] * 3 + [5e-2] * 3 + [10.0] * 3, dtype=torch.float64)
"""m, m/s, rad/s: about what the states are uncertain by."""


def outer(point: Tensor, coefficients: int = 0) -> Tensor:
    """A loss on all states (and coefficients) that is neither linear nor the same for any two."""
    split = len(point) - coefficients
    states = point[:split].view(-1, 9)
    weights = torch.randn(states.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    along = (weights * states / SPREAD).sum() / 100.0
    return along + 0.01 * along.square() + (point[split:] * 7.0).square().sum()


def gradients(
    estimates: Estimates, leaves: Sequence[Tensor], method: GradientMethod | None = None, coefficients: int = 0
) -> tuple[Tensor, ...]:
    point = estimates.attached(method or ImplicitGradient(), leaves)
    return torch.autograd.grad(outer(point, coefficients), leaves)


def worst(
    estimates: Estimates, groups: dict[str, Sequence[Tensor]], steps: Sequence[float], coefficients: int = 0
) -> float:
    """Largest relative error over groups of leaves, each along one random direction of all its numbers."""
    errors = {}
    leaves = [leaf for group in groups.values() for leaf in group]
    found = dict(zip(leaves, gradients(estimates, leaves, coefficients=coefficients), strict=True))
    for (name, group), step in zip(groups.items(), steps, strict=True):
        generator = torch.Generator().manual_seed(7)
        directions = [torch.randn(leaf.shape, generator=generator, dtype=torch.float64) for leaf in group]
        expected = directional(lambda: outer(estimates.point(), coefficients), group, directions, step)
        along = sum(float((found[leaf] * d).sum()) for leaf, d in zip(group, directions, strict=True))
        errors[name] = abs(along - expected) / abs(expected) if expected else abs(along)  # no ball slides: no friction
    print({name: f"{error:.0e}" for name, error in errors.items()})  # shown by -s
    return max(errors.values())


def each(leaves: dict[str, Tensor]) -> tuple[dict[str, Sequence[Tensor]], list[float]]:
    """Every coefficient by itself, with a step of half a percent."""
    steps = [5e-3 * float(leaf.detach().abs()) for leaf in leaves.values()]
    return {name: [leaf] for name, leaf in leaves.items()}, steps


@pytest.fixture(scope="module")
def analytic() -> Estimates:
    return Estimates(usual_ball(), measured(TRUTH), replace(SETTINGS, launcher=launcher()))


def test_the_problem_is_a_hard_one(analytic: Estimates) -> None:
    """Bounces, robust losses in their tails, residuals that bend: or the tests below prove little."""
    for found in analytic.solve():
        assert len(found.events.contacts) == 1
        rows = [(kind.loss, kind.linearize(found.minimum.values).residual) for kind in found.graph.batches]
        tails = [loss.name for loss, r in rows if np.linalg.norm(r, axis=1).max() > loss.scale]
        assert "huber" in tails
        assert found.minimum.error > 15.0


def test_coefficients_of_the_dynamics(analytic: Estimates) -> None:
    leaves = dict(analytic.model.named_parameters())
    assert len(leaves) == 8
    assert worst(analytic, *each(leaves)) < SAME


def test_spin_embedding(analytic: Estimates) -> None:
    embedding = analytic.settings.launcher.embedding
    assert worst(analytic, {"weight": [embedding.weight]}, [0.01]) < SAME


def test_a_tracker_with_memory_and_jitter() -> None:
    """Biases behind the states: the gradient of the states by coefficients and by the noise."""
    tracker = {"memory": (0.002, 0.003, 0.002), "memory_time": 0.03, "stamp_jitter": 0.0005}
    noise = NoiseScales(NOISE, learned=True)
    estimates = Estimates(usual_ball(), measured(TRUTH), replace(SETTINGS, launcher=launcher(), **tracker), noise)
    own = dict(estimates.model.named_parameters())
    leaves = [own["flight.drag.k"], own["bounce.restitution.e"], noise.position, noise.process]

    def value(point: Tensor) -> Tensor:
        return outer(point.view(-1, 12)[:, :9].reshape(-1))

    found = torch.autograd.grad(value(estimates.attached(ImplicitGradient(), leaves)), leaves)
    for leaf, gradient, step in zip(leaves, found, (5e-4, 2e-3, 3e-3, 3e-3), strict=True):
        direction = torch.linspace(0.5, 1.5, leaf.numel(), dtype=torch.float64).view(leaf.shape)
        expected = directional(lambda: value(estimates.point()), [leaf], [direction], step)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=SAME)


@pytest.mark.parametrize(("kind", "step"), [("mnn+gs", 1e-4), ("mlp", 3e-5)])
def test_weights_of_networks(kind, step) -> None:
    """Random directions in all weights of a network; small steps, since a residual lies 8e-5 from Huber's bend."""
    architecture = Architecture.of(kind, width_flight=5, width_contact=5, depth=2, residual=True, spin_rate=True)
    model = build(architecture, radius=0.02, base=usual_ball(), seed=3)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for weight in (*model.flight.parameters(), *model.contact.parameters()):
            weight += 0.01 * torch.randn(weight.shape, generator=generator, dtype=torch.float64)
    estimates = Estimates(model, measured(TRUTH)[:2], replace(SETTINGS, launcher=launcher()))
    groups = {"flight": list(model.flight.parameters()), "contact": list(model.contact.parameters())}
    assert worst(estimates, groups, [step, step]) < SAME


def test_noise() -> None:
    noise = NoiseScales(NOISE, learned=True)
    with torch.no_grad():
        noise.process += torch.tensor([0.1, -0.2, 0.3, -0.1, 0.2])
        noise.position.fill_(0.1)
        noise.spin.fill_(-0.1)
    estimates = Estimates(usual_ball(), measured(TRUTH), replace(SETTINGS, launcher=launcher()), noise)
    assert len(noise.names) == 5
    found = gradients(estimates, list(noise.parameters()))
    for name, leaf, gradient in zip(("process", "position", "spin"), noise.parameters(), found, strict=True):
        step = 3e-4 if name == "position" else 5e-3  # a larger one takes a residual over the bend of Huber's loss
        for k in range(leaf.numel()):
            direction = torch.eye(leaf.numel(), dtype=torch.float64)[k].view(leaf.shape)
            expected = directional(lambda: outer(estimates.point()), [leaf], [direction], step)
            print(f"{float(gradient.flatten()[k]) / expected - 1.0:.0e}")  # shown by -s
            assert float(gradient.flatten()[k]) == pytest.approx(expected, rel=SAME)


def test_scaling_all_noise_moves_nothing() -> None:
    """What the likelihood is needed for: with squared losses the gradient is orthogonal to a change of all scales.

    Priors that nobody learns are left out by making them say next to nothing.
    """
    noise = NoiseScales(NOISE, learned=True)
    plain = replace(SETTINGS, loss=Loss(), spin_loss=Loss(), label_loss=Loss(), spin_prior=1e5, velocity_prior=1e5)
    track = measured(TRUTH)[1:2]  # with a label
    estimates = Estimates(usual_ball(), track, plain, noise)
    process, position, spin = gradients(estimates, list(noise.parameters()))
    assert float(process.abs().max()) > 1e-2
    assert abs(float(process.sum() + position + spin)) < 1e-3 * float(process.abs().sum())


def test_priors_of_coefficients() -> None:
    """Coefficients of each track about the model's own: those values act through the prior's mean, others as ever."""
    model = usual_ball()
    settings = replace(SETTINGS, coefficients={"flight.drag.k": 0.03, "bounce.restitution.e": 0.02})
    estimates = Estimates(model, measured(TRUTH), settings)
    assert len(estimates.starts[0].coefficients) == 2
    leaves = {n: p for n, p in model.named_parameters() if n.split(".")[1] in ("drag", "restitution", "magnus")}
    assert worst(estimates, *each(leaves), coefficients=6) < SAME


# --- a linear problem, whose solution is a formula


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


# --- the three methods


def test_unrolling_tends_to_the_exact_gradient(analytic: Estimates) -> None:
    """By a factor of ten an iteration here: 0.1 after 2, 1e-3 after 4, 2e-7 after 8."""
    leaves = list(analytic.model.parameters())
    exact = gradients(analytic, leaves)
    errors = []
    for iterations in (2, 4, 8, 16):
        found = gradients(analytic, leaves, UnrolledGradient(iterations))
        errors.append(max(float((a / b - 1.0).abs()) for a, b in zip(found, exact, strict=True)))
    print([f"{error:.1e}" for error in errors])  # shown by -s
    assert errors[0] > 1e-3
    for earlier, later in pairwise(errors[:3]):
        assert later < 0.2 * earlier
    assert errors[-1] < 1e-7


def test_gauss_newton_is_an_approximation(analytic: Estimates) -> None:
    """By 2 to 80 %, half of the coefficients by more than 11 %: a third of the samples lies in the losses' tails."""
    leaves = list(analytic.model.parameters())
    exact, near = gradients(analytic, leaves), gradients(analytic, leaves, GaussNewtonGradient())
    errors = [float((a / b - 1.0).abs()) for a, b in zip(near, exact, strict=True)]
    print([f"{error:.2f}" for error in errors])  # shown by -s
    assert 0.01 < np.median(errors) < 0.3


def test_the_solver_is_seen_once_and_the_condition_only_backwards() -> None:
    """Nothing of the iterations is kept: a point comes in, a single product of the condition's graph goes out."""
    scale = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    calls: list[str] = []

    def solve() -> Tensor:
        calls.append("solve")
        return torch.full((3,), 0.5, dtype=torch.float64)

    def condition(point: Tensor) -> Tensor:  # of (scale x - 1)^2 / 2
        calls.append("condition")
        return scale * (scale * point - 1.0)

    class Exact:
        def __call__(self, product: Callable[[Tensor], Tensor], right: Tensor) -> Tensor:
            return right / product(torch.ones_like(right))

        def precondition(self, vector: Tensor) -> Tensor:
            return vector / 4.0

    for method, seen in ((ImplicitGradient(), 1), (GaussNewtonGradient(), 1), (UnrolledGradient(7), 7)):
        calls.clear()
        point = method(solve, condition, Exact(), [scale])
        assert calls.count("condition") == (seen if isinstance(method, UnrolledGradient) else 0)
        (found,) = torch.autograd.grad(point.sum(), [scale])
        assert calls == ["solve", *["condition"] * seen]
        assert float(found) == pytest.approx(-3 / 4.0, rel=1e-14)  # x = 1 / scale


def test_parameters_without_a_gradient_are_left_alone(analytic: Estimates) -> None:
    leaves = list(analytic.model.parameters())
    alone = gradients(analytic, leaves[:1])
    for frozen in leaves[1:]:
        frozen.requires_grad_(False)
    try:
        point = analytic.attached(ImplicitGradient(), leaves)
        torch.testing.assert_close(torch.autograd.grad(outer(point), leaves[:1])[0], alone[0], rtol=0, atol=0)
        leaves[0].requires_grad_(False)
        assert not analytic.attached(ImplicitGradient(), leaves).requires_grad
    finally:
        for leaf in leaves:
            leaf.requires_grad_(True)


def test_iterations_must_be_positive() -> None:
    with pytest.raises(ValueError, match="iterations must be at least 1; got 0"):
        UnrolledGradient(0)


# --- no gradient where there is none


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
