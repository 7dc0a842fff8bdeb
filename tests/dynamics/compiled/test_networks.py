"""Compiled networks against torch: every kind, alone and as a correction that fades; new weights need no new code.

Those that take long to compile are in `make test-all`; a small correction has all that they have but for fading.
"""

import copy

import numpy as np
import pytest
import torch

from ballfg.dynamics import Architecture, build, nominal_model
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.compiled.functions import compiled
from ballfg.dynamics.compiled.motion import functions_of
from ballfg.dynamics.compiled.translation.arrays import narrowest
from ballfg.dynamics.compiled.translation.trace import trace
from ballfg.dynamics.motion.by_machine_code import fly_jacobian
from ballfg.dynamics.motion.contact import fly_through
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.networks.fading import Fading
from tests.dynamics.compiled.test_functions import agree, states
from tests.dynamics.in_tensors import fly_through_jacobian
from tests.small_networks import SMALL

KINDS = ("mlp", "mlp+gs", "skip+gs", "mnn+gs")


def network(kind, *, seed=3, residual=False, **sizes):
    base = nominal_model(0.02) if residual else None
    model = build(Architecture.of(kind, residual=residual, **sizes), radius=0.02, base=base, seed=seed)
    for part in (model.flight, model.contact):
        generator = torch.Generator().manual_seed(seed)
        torch.nn.init.normal_(part.network.last.weight, std=0.05, generator=generator)
    return model.requires_grad_(False)


def faded(kind):
    """A correction that fades, with doubts about what is left of it."""
    model, tracks = network(kind, residual=True, **SMALL), [states() for _ in range(20)]
    model.fading = Fading.of(tracks, [track[:4] for track in tracks], 0.02)
    flying = torch.cat(tracks)
    guess = model.base.after_bounce(flying)
    model.fading.measure(model.flight(flying)[0], model.contact(flying, guess) - guess)
    for doubt in (model.fading.flight, model.fading.contact):
        doubt.fill_(0.3)
    return model


def small(kind):
    """A correction that does not fade."""
    return network(kind, residual=True, **SMALL)


either = pytest.mark.parametrize("made", [small, pytest.param(faded, marks=pytest.mark.thorough)])


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_network(kind) -> None:
    agree(network(kind))


def test_a_small_correction() -> None:
    agree(small("mnn+gs"))


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_corrections_of_a_model_that_fade(kind) -> None:
    agree(faded(kind))


@pytest.mark.thorough
def test_networks_that_give_spin_rates_and_small_ones() -> None:
    agree(network("mnn+gs", spin_rate=True))
    agree(network("mlp+gs", width_flight=5, width_contact=4, depth=1))
    agree(network("mnn+gs", residual=True))


@either
def test_weights_are_those_of_the_moment(made) -> None:
    model = made("mnn+gs")
    other = copy.deepcopy(model)
    assert compiled(other) is compiled(model)
    agree(model)
    with torch.no_grad():
        next(other.flight.network.parameters()).mul_(0.5)
        agree(other)
        other.contact.network.last.weight.add_(0.01)
    agree(other)
    agree(model)


@either
def test_coefficients_that_travel_with_the_state_of_a_learned_model(made) -> None:
    first = "fading.flight" if made is faded else "base.bounce.restitution.e"
    model = AugmentedModel(made("mnn+gs"), (first, "base.flight.drag.k"))
    known = functions_of(model)
    assert known is not None
    rows = torch.cat((states(), torch.tensor([[0.3, 0.11]], dtype=torch.float64).expand(12, 2)), dim=1)
    dt = torch.full((12,), 0.12, dtype=torch.float64)
    after, jacobian = fly_jacobian(model, known, rows, dt)
    torch.testing.assert_close(after, fly(model, rows, dt), rtol=1e-12, atol=1e-12)
    right = torch.autograd.functional.jacobian(lambda x: fly(model, x, dt).sum(0), rows).transpose(0, 1)
    torch.testing.assert_close(jacobian, right, rtol=1e-10, atol=1e-10)
    after, _, _ = fly_through_jacobian(model, rows, dt, (0.76,))
    torch.testing.assert_close(after, fly_through(model, rows, dt, (0.76,))[0], rtol=1e-10, atol=1e-10)


def test_the_narrowest_place_of_a_function() -> None:
    """Twenty numbers that are made of two sums depend on the state through these."""

    def wide(x):
        one, other = x[:3].sum(), (x[3:6] * x[6:]).sum()
        return torch.stack([one**k * other for k in range(1, 11)] + [one + k * other for k in range(10)])

    traced = trace(wide, [9])
    assert len(narrowest(traced.program, traced.outputs)) == 2
    assert len(narrowest(traced.program, traced.inputs[0])) == 9


def test_a_function_of_tables_alone_is_computed_by_torch() -> None:
    table = torch.arange(400.0, dtype=torch.float64).reshape(20, 20)
    traced = trace(lambda x, t: (x.unsqueeze(0) @ (t @ t)[:9]).squeeze(0).sum(), [9], [table])
    assert traced.weights is not None
    np.testing.assert_allclose(traced.weights(table).numpy(), (table @ table)[:9].reshape(-1).numpy())
