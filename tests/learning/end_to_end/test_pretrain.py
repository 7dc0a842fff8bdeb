"""Networks fitted to a teacher: what is left, where it is measured, and that the same seed gives the same weights."""

from __future__ import annotations

import pytest
import torch

from ballfg.dynamics import nominal_model
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import LearnedModel, build
from ballfg.learning.end_to_end.pretrain import pretrain
from ballfg.state import SPIN, VELOCITY
from tests.learning.estimates import usual_ball

SAMPLES = 300


def small(kind: str = "mnn+gs", *, spin_rate: bool = False) -> LearnedModel:
    architecture = Architecture.of(kind, width_flight=8, width_contact=8, depth=2, spin_rate=spin_rate)
    return build(architecture, radius=0.02, seed=1)


def misfit(model: LearnedModel, teacher, seed: int, *, spin_rate: bool = False) -> float:
    """Root mean square over states of a generator's own, in the units that `pretrain` states."""
    rng = torch.Generator().manual_seed(seed)
    state = torch.randn(4000, 9, generator=rng, dtype=torch.float64) * torch.tensor([0.0] * 3 + [4.0] * 3 + [120.0] * 3)
    falling = state.clone()
    falling[:, 5] = -0.3 - falling[:, 5].abs()
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
    before = misfit(model, teacher, 99)
    left = pretrain(model, teacher, seed=0, iterations=60, samples=SAMPLES)
    after = misfit(model, teacher, 99)
    print(before, left, after)  # shown by -s
    assert after < 0.5 * before
    assert left == pytest.approx(after, rel=0.4)


def test_what_is_left_is_what_is_returned() -> None:
    """No iterations past the first: the states of the seed, the units of the module."""
    model, teacher = small(spin_rate=True), usual_ball()  # whose spin decays
    left = pretrain(model, teacher, seed=3, iterations=1, samples=SAMPLES)
    assert left == pytest.approx(misfit(model, teacher, 4, spin_rate=True), rel=0.3)


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
