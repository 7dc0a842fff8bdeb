"""Networks fitted to a teacher: what is left, where it is measured, and that the same seed gives the same weights."""

from __future__ import annotations

import pytest
import torch

from ballfg.dynamics import nominal_model
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import LearnedModel, build
from ballfg.learning.end_to_end.pretrain import pretrain, random_states
from ballfg.state import POSITION, SPIN, VELOCITY
from tests.learning.estimates import usual_ball

SAMPLES = 300


def small(kind: str = "mnn+gs", *, spin_rate: bool = False) -> LearnedModel:
    architecture = Architecture.of(kind, width_flight=8, width_contact=8, depth=2, spin_rate=spin_rate)
    return build(architecture, radius=0.02, seed=1)


def misfit(model: LearnedModel, teacher, state, falling, *, spin_rate: bool = False) -> float:
    """Root mean square over flights and bounces, in the units that `pretrain` states."""
    with torch.no_grad():
        (a, w), (b, u) = model.rates(state), teacher.rates(state)
        after = model.after_bounce(falling) - teacher.after_bounce(falling)
    squares = (
        (a - b).square().mean() + (after[:, VELOCITY] / 0.1).square().mean() + (after[:, SPIN] / 10).square().mean()
    )
    if spin_rate:
        squares = squares + ((w - u) / 10).square().mean()
    return float(squares) ** 0.5


def test_a_fit_is_better_on_states_that_it_did_not_see() -> None:
    model, teacher = small(), nominal_model()
    before = misfit(model, teacher, *random_states(99, 4000))
    left = pretrain(model, teacher, seed=0, iterations=60, samples=SAMPLES)
    after = misfit(model, teacher, *random_states(99, 4000))
    print(before, left, after)  # shown by -s
    assert after < 0.5 * before
    assert left == pytest.approx(after, rel=0.4)


def test_what_is_left_is_what_is_returned() -> None:
    """On the states of the seed, in the units of the module: the same number by a sum of its own, up to rounding."""
    model, teacher = small(spin_rate=True), usual_ball()  # whose spin decays
    left = pretrain(model, teacher, seed=3, iterations=1, samples=SAMPLES)
    expected = misfit(model, teacher, *random_states(3, SAMPLES), spin_rate=True)
    assert left == pytest.approx(expected, rel=1e-12)


def test_random_states_fill_the_room_of_speeds_and_spins() -> None:
    """4 m/s and 120 rad/s an axis; 1e4 draws tell a standard deviation to 0.7 %: five of them."""
    flying, falling = random_states(5, 10_000)
    for state in (flying, falling):
        assert not state[:, POSITION].any()
        torch.testing.assert_close(
            state[:, SPIN].std(0), torch.full((3,), 120.0, dtype=torch.float64), rtol=0.035, atol=0
        )
    torch.testing.assert_close(
        flying[:, VELOCITY].std(0), torch.full((3,), 4.0, dtype=torch.float64), rtol=0.035, atol=0
    )
    assert falling[:, 5].max() <= -0.3
    assert float(falling[:, 5].mean()) == pytest.approx(-0.3 - 4.0 * (2.0 / torch.pi) ** 0.5, rel=0.035)


def test_the_same_seed_gives_the_same_weights() -> None:
    first, second, other = small(), small(), small()
    pretrain(first, nominal_model(), seed=0, iterations=3, samples=SAMPLES)
    pretrain(second, nominal_model(), seed=0, iterations=3, samples=SAMPLES)
    pretrain(other, nominal_model(), seed=1, iterations=3, samples=SAMPLES)
    for (name, a), b, c in zip(first.named_parameters(), second.parameters(), other.parameters(), strict=True):
        assert torch.equal(a, b), name
        assert not torch.equal(a, c) or name == "offset"


def test_only_the_networks_change() -> None:
    """Not the surfaces' offset, and nothing of the teacher; no gradient is left behind in it."""
    model, teacher = small("mlp"), usual_ball()
    offset, values = model.offset.detach().clone(), [p.detach().clone() for p in teacher.parameters()]
    pretrain(model, teacher, seed=0, iterations=2, samples=SAMPLES)
    assert torch.equal(model.offset, offset)
    assert all(torch.equal(p, v) for p, v in zip(teacher.parameters(), values, strict=True))
    assert all(p.grad is None for p in teacher.parameters())
