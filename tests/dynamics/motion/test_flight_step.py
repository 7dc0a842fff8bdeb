"""A flight step with its own derivatives against autograd through the plain Runge-Kutta step."""

from __future__ import annotations

import pytest
import torch

from ballfg.dynamics import nominal_model
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.flight_step import rk4_step
from ballfg.dynamics.motion.step_twice import flight_step
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import build
from tests.small_networks import SMALL

NAMES = ("flight.drag.k", "flight.magnus.k")


def shaken(model: BallModel) -> BallModel:
    """Weights away from where they start, so that nothing is zero."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.dim():
                parameter += 0.1 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
    return model


MODELS = {
    "analytic": nominal_model,
    "augmented": lambda: AugmentedModel(nominal_model(), NAMES),
    "mnn+gs": lambda: shaken(build(Architecture.of("mnn+gs", **SMALL), radius=0.02)),
    "mlp": lambda: shaken(build(Architecture.of("mlp", **SMALL), radius=0.02)),
    "residual, spin rate": lambda: shaken(
        build(Architecture.of("skip+gs", **SMALL, residual=True, spin_rate=True), radius=0.02, base=nominal_model())
    ),
}


IN_TORCH = "mnn+gs, in torch"
QUICK = ("analytic", "augmented", IN_TORCH)
"""The machine code of a network takes half a minute to make; that of the analytic model is stepped by the same code."""


@pytest.fixture(params=[pytest.param(n, marks=[pytest.mark.thorough] * (n not in QUICK)) for n in (*MODELS, IN_TORCH)])
def model(request: pytest.FixtureRequest) -> BallModel:
    if request.param == IN_TORCH:
        request.getfixturevalue("networks_in_torch")
        return MODELS["mnn+gs"]()
    return MODELS[request.param]()


def states(model: BallModel, count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([1.0] * 3 + [4.0] * 3 + [80.0] * 3, dtype=torch.float64)
    state = scale * torch.randn((count, 9), generator=generator, dtype=torch.float64)
    if not isinstance(model, AugmentedModel):
        return state
    return model.append(state, torch.tensor([0.13, 0.003], dtype=torch.float64))


def flat(gradients, parameters) -> torch.Tensor:
    pairs = zip(gradients, parameters, strict=True)
    return torch.cat([(torch.zeros_like(p) if g is None else g).reshape(-1) for g, p in pairs])


@pytest.mark.parametrize("count", [1, 7])
def test_all_derivatives(model, count) -> None:
    """Value, gradient by state and parameters, Hessian times vector, mixed second derivative: to rounding."""
    start, h = states(model, count), torch.full((count, 1), 0.012, dtype=torch.float64)
    a, v = torch.cos(torch.arange(start.numel()).reshape(start.shape).double()), torch.sin(start)
    parameters = list(model.parameters())
    found = []
    for step in (lambda s: flight_step(model, s, h), lambda s: rk4_step(model.rates, s, h)):
        state = start.clone().requires_grad_(True)
        after = step(state)
        value = (after * a).sin().sum() + 0.1 * after.square().sum()
        (gradient,) = torch.autograd.grad(value, state, create_graph=True)
        (product,) = torch.autograd.grad(gradient, state, v, retain_graph=True)
        (again,) = torch.autograd.grad(gradient, state, a, retain_graph=True)  # another direction, the same graph
        mixed = torch.autograd.grad(gradient, parameters, v, retain_graph=True, allow_unused=True)
        first = torch.autograd.grad(value, parameters, allow_unused=True)
        found.append((after, gradient, product, again, flat(mixed, parameters), flat(first, parameters)))
    for own, plain in zip(*found, strict=True):
        torch.testing.assert_close(own, plain, rtol=1e-11, atol=1e-12 * float(plain.detach().abs().max()))


def test_without_parameters_to_learn(model) -> None:
    start, h = states(model, 3), torch.full((3, 1), 0.012, dtype=torch.float64)
    model.requires_grad_(False)
    state = start.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(flight_step(model, state, h).square().sum(), state, create_graph=True)
    (product,) = torch.autograd.grad(gradient.sum(), state)
    plain = start.clone().requires_grad_(True)
    (expected,) = torch.autograd.grad(rk4_step(model.rates, plain, h).square().sum(), plain, create_graph=True)
    torch.testing.assert_close(gradient, expected)
    torch.testing.assert_close(product, torch.autograd.grad(expected.sum(), plain)[0])
