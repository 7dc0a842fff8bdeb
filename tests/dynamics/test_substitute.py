"""Other values in place of a model's parameters, and coefficients that travel with the state."""

from __future__ import annotations

import pytest
import torch

from ballfg.dynamics import Surfaces
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import substitute, take_rows
from ballfg.dynamics.motion.contact import fly_through
from ballfg.dynamics.motion.integrate import batch_jacobian, fly, fly_jacobian
from ballfg.dynamics.motion.rollout import advance
from tests.dynamics.in_tensors import fly_through_jacobian

NAMES = (
    "flight.drag.k",
    "flight.magnus.k",
    "bounce.restitution.e",
    "bounce.friction.mu",
    "bounce.table_height.offset",
)


@pytest.fixture
def augmented(model, states):
    ball = AugmentedModel(model, NAMES)
    coefficients = torch.tensor((0.11, 0.002, 0.88, 0.3, -0.002), dtype=torch.float64)
    spread = torch.linspace(0.9, 1.1, 7, dtype=torch.float64)[:, None]
    return ball, ball.append(states(7), spread * coefficients)


def test_the_original_stays_and_the_copy_shares_the_rest(model, states):
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    other = substitute(model, {"flight.drag.k": torch.tensor(0.5, dtype=torch.float64)})
    assert other.flight["drag"].k.item() == 0.5
    assert other.flight["magnus"] is model.flight["magnus"]
    assert model.flight["drag"].k.item() == before["flight.drag.k"].item()
    assert {n for n, _ in model.named_parameters()} == set(before)
    assert "flight.drag.k" not in dict(other.named_parameters())
    again = substitute(other, {"flight.drag.k": torch.tensor(0.7, dtype=torch.float64)})
    assert (again.flight["drag"].k.item(), other.flight["drag"].k.item()) == (0.7, 0.5)


@pytest.mark.parametrize("name", ["flight.drag.kk", "flight.wind.k", "nothing"])
def test_unknown_names(model, name):
    with pytest.raises(KeyError):
        substitute(model, {name: torch.tensor(0.5)})


def test_per_row_values_are_what_each_row_has_alone(model, states):
    state, dt = states(4), torch.full((4,), 0.05, dtype=torch.float64)
    k = torch.linspace(0.05, 0.2, 4, dtype=torch.float64)
    after, jacobian = fly_jacobian(substitute(model, {"flight.drag.k": k[:, None]}), state, dt)
    for i in range(4):
        alone, own = fly_jacobian(substitute(model, {"flight.drag.k": k[i]}), state[i : i + 1], dt[:1])
        torch.testing.assert_close(after[i : i + 1], alone, rtol=0, atol=1e-13)
        torch.testing.assert_close(jacobian[i : i + 1], own, rtol=0, atol=1e-13)


def test_gradient_reaches_the_given_tensors(model, states):
    k = torch.full((3, 1), 0.1, dtype=torch.float64, requires_grad=True)
    ball = substitute(model, {"flight.drag.k": k, "bounce.restitution.e": torch.tensor(0.9, dtype=torch.float64)})
    after = advance(ball, states(3), torch.full((3,), 0.4, dtype=torch.float64), Surfaces(0.0))
    (gradient,) = torch.autograd.grad(after[1, :3].sum(), k)
    assert gradient[1].abs().item() > 0
    assert gradient[[0, 2]].abs().max().item() == 0  # other rows have other values


def test_take_rows(model, network):
    rows = torch.tensor((True, False, True))
    assert take_rows(model, rows, 3) is model
    assert take_rows(network, rows, 3) is network
    k = torch.tensor(((0.1,), (0.2,), (0.3,)), dtype=torch.float64)
    ball = substitute(model, {"flight.drag.k": k, "flight.magnus.k": torch.tensor(0.001, dtype=torch.float64)})
    part = take_rows(ball, rows, 3)
    assert part.flight["drag"].k[:, 0].tolist() == [0.1, 0.3]
    assert part.flight["magnus"].k.item() == 0.001
    assert ball.flight["drag"].k.shape == (3, 1)


def test_augmented_motion_is_that_of_the_substituted_model(augmented, model):
    ball, state = augmented
    dt = torch.full((7,), 0.4, dtype=torch.float64)
    with torch.no_grad():
        after = advance(ball, state, dt, Surfaces(0.0, -0.76))
        plain = advance(ball.bound(state), state[:, :9], dt, Surfaces(0.0, -0.76))
    torch.testing.assert_close(after[:, :9], plain, rtol=1e-12, atol=1e-12)
    assert torch.equal(after[:, 9:], state[:, 9:])


@pytest.mark.parametrize("heights", [(), (0.0,), (0.0, 0.0)])
def test_augmented_jacobian_by_two_routes(augmented, heights):
    ball, state = augmented
    dt = torch.full((7,), 0.1 + 0.3 * len(heights), dtype=torch.float64)
    state[:, 2] -= 0.15
    _, _, jacobian = fly_through_jacobian(ball, state, dt, heights)

    def flow(s):
        batch = s.reshape(-1, 14)
        return fly_through(ball, batch, dt.repeat(len(batch) // 7), heights)[0].reshape(s.shape)

    _, by_autograd = batch_jacobian(flow, state, outputs=14)
    torch.testing.assert_close(jacobian, by_autograd, rtol=1e-6, atol=1e-6)
    assert torch.equal(jacobian[:, 9:, 9:], torch.eye(5, dtype=torch.float64).expand(7, 5, 5))


def test_augmented_coefficient_columns_against_differences(augmented):
    ball, state = augmented
    state[:, 2] -= 0.15
    dt = torch.full((7,), 0.1, dtype=torch.float64)
    _, _, jacobian = fly_through_jacobian(ball, state, dt, (0.0,))
    with torch.no_grad():
        for j in range(9, 14):
            step = torch.zeros(14, dtype=torch.float64)
            step[j] = 1e-5
            plus, minus = (fly_through(ball, state + sign * step, dt, (0.0,))[0] for sign in (1, -1))
            torch.testing.assert_close(jacobian[..., j], (plus - minus) / 2e-5, rtol=1e-5, atol=1e-5)


def test_augmented_flight_without_contact(augmented):
    ball, state = augmented
    dt = torch.full((7,), 0.03, dtype=torch.float64)
    _, jacobian = fly_jacobian(ball, state, dt)
    _, by_autograd = batch_jacobian(lambda s: fly(ball, s, dt), state)
    torch.testing.assert_close(jacobian, by_autograd, rtol=1e-12, atol=1e-12)


def test_augmented_names_are_checked(model, network):
    with pytest.raises(
        ValueError, match=r"^'drag' is not a scalar parameter of the model; there are: flight\.gravity\.g"
    ):
        AugmentedModel(model, ["drag"])
    with pytest.raises(ValueError, match=r"^'air\.0\.weight' is not a scalar parameter"):
        AugmentedModel(network, ["air.0.weight"])
