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

from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import build
from ballfg.factors.loss import Loss
from ballfg.learning.end_to_end.learnables import NoiseScales
from ballfg.learning.gradient.implicit import GaussNewtonGradient, ImplicitGradient, UnrolledGradient
from tests.learning.estimates import NOISE, SETTINGS, Estimates, directional, launcher, measured, usual_ball
from tests.learning.gradient.outer_loss import TRUTH, gradients, outer
from tests.small_networks import SMALL

SAME = 1e-6


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


@pytest.mark.usefixtures("networks_in_torch")
@pytest.mark.parametrize(("kind", "step"), [("mnn+gs", 1e-4), pytest.param("mlp", 3e-5, marks=pytest.mark.thorough)])
def test_weights_of_networks(kind, step) -> None:
    """Random directions in all weights of a network; small steps, since a residual lies 8e-5 from Huber's bend."""
    architecture = Architecture.of(kind, **SMALL, residual=True, spin_rate=True)
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
