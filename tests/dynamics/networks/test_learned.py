"""Learned models: how they start, what they cannot break, and that they do all that a ball model does."""

from __future__ import annotations

import pytest
import torch

from ballfg.dynamics import AnalyticModel, Architecture, Surfaces, build, nominal_model, rollout
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.effect import Coefficient
from ballfg.dynamics.model import substitute, take_rows
from ballfg.dynamics.motion.contact import contact_time, fly_through
from ballfg.dynamics.motion.flight_step import rate_jacobian
from ballfg.dynamics.motion.integrate import batch_jacobian, fly, fly_jacobian
from ballfg.dynamics.networks.learned import HIGHEST_RESTITUTION, START_RESTITUTION
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.estimation.segmentation.physics import physics_of
from tests.dynamics.in_tensors import fly_through_jacobian
from tests.small_networks import SMALL

pytestmark = pytest.mark.usefixtures("networks_in_torch")
KINDS = ("mlp", "mlp+gs", "skip+gs", "mnn+gs")
SYMMETRIC = KINDS[1:]
GRAVITY = (0.0, 0.0, -9.81)


def model_of(kind, *, size=0.05, radius=0.02, base=None, seed=0, **options):
    """A model whose last layers are not zero: as if trained, to nonsense of a moderate size."""
    model = build(Architecture.of(kind, residual=base is not None, **options), radius=radius, base=base, seed=seed)
    generator = torch.Generator().manual_seed(seed + 1)
    for part in (model.flight, model.contact):
        torch.nn.init.normal_(part.network.last.weight, std=size, generator=generator)
    return model


def turned(state, matrix):
    flip = torch.linalg.det(matrix)
    position, velocity, spin = state.split(3, dim=-1)
    return torch.cat((position @ matrix.T, velocity @ matrix.T, flip * (spin @ matrix.T)), dim=-1)


def about_z(mirror):
    matrix = torch.tensor([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], dtype=torch.float64)
    return matrix @ torch.diag(torch.tensor((1.0, -1.0 if mirror else 1.0, 1.0), dtype=torch.float64))


@pytest.mark.parametrize("kind", KINDS)
def test_sizes_are_comparable(kind):
    """7,346 parameters in the paper; here with an embedding of two launcher settings."""
    embedding = SpinEmbedding(("topspin", "sidespin"), {})
    total = build(Architecture.of(kind), radius=0.02).parameter_count + sum(p.numel() for p in embedding.parameters())
    assert abs(total - 7346) < 0.01 * 7346


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("spin_rate", [False, True])
def test_untrained_it_falls_in_vacuum_and_bounces_up(kind, spin_rate, states):
    model, state = build(Architecture.of(kind, spin_rate=spin_rate), radius=0.02), states(20)
    acceleration, angular = model.rates(state)
    assert torch.allclose(acceleration, torch.tensor(GRAVITY, dtype=torch.float64).expand(20, 3), rtol=1e-15)
    assert angular is None if not spin_rate else bool((angular == 0).all())
    after = state.clone()
    after[:, 5] *= -START_RESTITUTION
    assert torch.allclose(model.after_bounce(state), after, rtol=1e-15)
    assert physics_of(model).restitution == pytest.approx(START_RESTITUTION)
    assert physics_of(model).gravity == pytest.approx(9.81)
    assert physics_of(model).surface_offset == -0.003


@pytest.mark.parametrize("kind", KINDS)
def test_untrained_corrections_correct_nothing(kind, every_effect, states):
    state = states(20)
    model = build(Architecture.of(kind, residual=True, spin_rate=True), radius=0.02, base=every_effect)
    for ours, its in zip(model.rates(state), every_effect.rates(state), strict=True):
        assert torch.equal(ours, its)
    assert torch.equal(model.after_bounce(state), every_effect.after_bounce(state))
    assert physics_of(model) == physics_of(every_effect)


def test_the_spin_rate_is_whoever_has_one(every_effect, states):
    state = states(3)
    constant = AnalyticModel([e for n, e in every_effect.flight.items() if n != "spin_decay"])
    assert model_of("mnn+gs", base=constant).rates(state)[1] is None
    assert torch.equal(model_of("mnn+gs", base=every_effect).rates(state)[1], every_effect.rates(state)[1])
    own = model_of("mnn+gs", base=constant, spin_rate=True).rates(state)[1]
    both = model_of("mnn+gs", base=every_effect, spin_rate=True).rates(state)[1]
    assert torch.allclose(both, own + every_effect.rates(state)[1], rtol=1e-14)


@pytest.mark.parametrize(
    "kind", [*(pytest.param(kind, marks=pytest.mark.thorough) for kind in SYMMETRIC[:-1]), SYMMETRIC[-1]]
)
@pytest.mark.parametrize("mirror", [False, True])
def test_symmetric_about_z(kind, mirror, every_effect, states):
    state, matrix = states(10), about_z(mirror)
    times = torch.linspace(0.1, 0.5, 3, dtype=torch.float64)
    surfaces = Surfaces(0.0)
    for base in (None, every_effect):
        model = model_of(kind, base=base, spin_rate=True, **SMALL)
        assert torch.allclose(
            model.after_bounce(turned(state, matrix)), turned(model.after_bounce(state), matrix), atol=1e-11
        )
        there = rollout(model, turned(state, matrix), times, surfaces)
        assert torch.allclose(there, turned(rollout(model, state, times, surfaces), matrix), rtol=0, atol=1e-10)


def test_raw_is_not_symmetric(states):
    state, model = states(10), model_of("mlp")
    there = model.rates(turned(state, about_z(False)))[0]
    assert not torch.allclose(there, model.rates(state)[0] @ about_z(False).T, atol=0.1)


@pytest.mark.parametrize("kind", SYMMETRIC)
def test_the_air_knows_no_direction_but_gravity(kind, states):
    """Without the bias the acceleration turns with the ball, about any axis."""
    model, state = model_of(kind), states(10)
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64))
    gravity = torch.tensor(GRAVITY, dtype=torch.float64)
    air = model.rates(state)[0] - gravity
    assert torch.allclose(model.rates(turned(state, q))[0] - gravity, air @ q.T, rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_a_falling_ball_always_leaves_upwards(kind, states):
    state = states(200, seed=4)
    state[:, 5] = -state[:, 5].abs()
    for size in (0.1, 1.0, 10.0):
        up = model_of(kind, size=size).after_bounce(state)[:, 5]
        assert bool((up >= 0).all())
        assert bool((up <= (HIGHEST_RESTITUTION + 1e-12) * -state[:, 5]).all())


@pytest.mark.parametrize("residual", [False, True])
def test_a_network_may_choose_any_restitution_up_to_the_highest(residual, every_effect, states):
    """From none at all over the first guess to `HIGHEST_RESTITUTION` times it, with one output."""
    base = every_effect if residual else None
    model, state = build(Architecture.of("mlp", residual=residual), radius=0.02, base=base), states(5)
    state[:, 5] = -1.0 - state[:, 5].abs()
    guess, ratios = model.after_bounce(state)[:, 5].detach(), []
    for output in (-40.0, -0.5, 0.0, 0.5, 40.0):
        torch.nn.init.zeros_(model.contact.network.last.bias)
        with torch.no_grad():
            model.contact.network.last.bias[0] = output
            ratios.append(float((model.after_bounce(state)[:, 5] / guess).mean()))
    highest = HIGHEST_RESTITUTION / (1.0 if residual else START_RESTITUTION)
    assert ratios[0] == pytest.approx(0.0, abs=1e-12)
    assert ratios[2] == 1.0
    assert ratios[4] == pytest.approx(highest, rel=1e-12)
    assert ratios == sorted(ratios)


@pytest.mark.parametrize("kind", SYMMETRIC)
def test_far_from_all_training_features_stay_bounded(kind, states):
    """Ten times the speed and spin: coefficients, hence drag per speed, are of the size they are at usual speeds."""
    model, state = model_of(kind), states(200)
    usual = ((model.rates(state)[0])[:, 2] + 9.81).abs().max()
    far = state.clone()
    far[:, 3:] *= 10
    assert (model.rates(far)[0][:, 2] + 9.81).abs().max() < 1e4 * usual  # terms of second and third order
    no_spin = torch.cat((far[:, :6], torch.zeros(200, 3, dtype=torch.float64)), dim=-1)
    drag = (model.rates(no_spin)[0] - torch.tensor(GRAVITY, dtype=torch.float64)).norm(dim=-1)
    assert bool((drag < 2 * no_spin[:, 3:6].norm(dim=-1)).all())


@pytest.mark.parametrize(
    ("kind", "spin_rate"),
    [
        pytest.param(
            kind, rate, marks=[pytest.mark.thorough] * ((kind, rate) not in (("mlp", False), ("mnn+gs", True)))
        )
        for kind in KINDS
        for rate in (False, True)
    ],
)
def test_jacobians(kind, spin_rate, states, differences):
    """Of a flight and of a contact, against differences."""
    model, state = model_of(kind, spin_rate=spin_rate, **SMALL), states(4)
    dt = torch.tensor((0.01, 0.008, 0.02, 0.013), dtype=torch.float64)
    _, flight = fly_jacobian(model, state, dt)
    assert torch.allclose(flight, differences(lambda s: fly(model, s, dt), state), rtol=1e-7, atol=1e-8)
    heavy, light = (rate_jacobian(model.rates, state, heavy=h) for h in (True, False))
    assert torch.allclose(heavy, light, rtol=0, atol=1e-12)
    before = fly(model, state, contact_time(model, state, 0.0)).detach()
    _, impact = batch_jacobian(model.after_bounce, before)
    assert torch.allclose(impact, differences(model.after_bounce, before), rtol=1e-6, atol=1e-7)
    dt = contact_time(model, state, 0.0).detach() + 0.005
    _, _, through = fly_through_jacobian(model, state, dt, (0.0,))
    expected = differences(lambda s: fly_through(model, s, dt, (0.0,))[0], state)
    assert torch.allclose(through, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.thorough] * (k != "mnn+gs")) for k in KINDS])
def test_a_gradient_reaches_every_parameter(kind, states):
    model, state = model_of(kind, spin_rate=True, **SMALL), states(8)
    after = rollout(model, state, torch.tensor([0.2, 0.5], dtype=torch.float64), Surfaces(0.0))
    gradients = torch.autograd.grad((after * torch.linspace(1, 2, 9)).sum(), list(model.parameters()))
    assert all(bool(g.isfinite().all()) and bool((g != 0).any()) for g in gradients)


def test_coefficients_of_the_base_travel_with_the_state(every_effect, states, differences):
    model, state = model_of("mnn+gs", base=every_effect), states(5)
    names = ("base.flight.drag.k", "base.bounce.restitution.e", "base.bounce.table_height.offset")
    assert set(names) <= set(model.declared_coefficients())
    ball = AugmentedModel(model, names)
    values = torch.tensor((0.11, 0.88, -0.002), dtype=torch.float64) * torch.linspace(0.9, 1.1, 5).double()[:, None]
    dt = torch.full((5,), 0.3, dtype=torch.float64)
    together = fly_through(ball, ball.append(state, values), dt, (0.0,))[0]
    for i in range(5):
        own = substitute(model, dict(zip(names, values[i], strict=True)))
        alone = fly_through(own, state[i : i + 1], dt[:1], (0.0,))[0]
        assert torch.allclose(together[i : i + 1, :9], alone, rtol=0, atol=1e-6)  # step counts differ
    rows = torch.tensor((True, False, True, False, False))
    part = take_rows(substitute(model, dict(zip(names, values.split(1, dim=-1), strict=True))), rows, 5)
    assert torch.equal(part.base.flight["drag"].k, values[rows, :1])
    assert part.flight is model.flight


def test_the_offset_is_a_coefficient(states):
    model, state = model_of("mnn+gs"), states(3)
    (name,) = model.declared_coefficients()
    assert isinstance(model.declared_coefficients()[name], Coefficient)
    ball = AugmentedModel(model, (name,))
    lifted = ball.append(state, torch.tensor([[0.0], [0.001], [0.002]], dtype=torch.float64))
    expected = state[:, 2] - 0.02 - torch.tensor((0.0, 0.001, 0.002), dtype=torch.float64)
    assert torch.allclose(ball.gap(lifted, 0.0), expected, rtol=0, atol=1e-15)
    assert torch.allclose(model.gap(state, 0.0), state[:, 2] - 0.02 + 0.003, rtol=0, atol=1e-15)


def test_the_same_seed_gives_the_same_weights():
    one, same, other = (model_of("mnn+gs", seed=s) for s in (1, 1, 2))
    for (name, value), again in zip(one.named_parameters(), same.parameters(), strict=True):
        assert torch.equal(value, again), name
    assert not torch.equal(one.flight.network.first.weight, other.flight.network.first.weight)


def test_sizes_can_be_given():
    architecture = Architecture.of("skip+gs", width_flight=5, width_contact=6, depth=1)
    assert (architecture.width_flight, architecture.width_contact, architecture.depth) == (5, 6, 1)
    model = build(architecture, radius=0.02)
    flight, contact = (3 + 1) * 5 + 6 * 5 + 6 * 3, (6 + 1) * 6 + 7 * 6 + 7 * 9
    assert model.parameter_count == flight + contact + 2
    assert "skip+gs" in repr(model)


def test_base_and_architecture_must_agree():
    with pytest.raises(ValueError, match=r"base must be given if, and only if, the architecture is residual; got "):
        build(Architecture.of("mlp", residual=True), radius=0.02)
    with pytest.raises(ValueError, match=r"residual=False and base=AnalyticModel.*Change one of them\.$"):
        build(Architecture.of("mlp"), radius=0.02, base=AnalyticModel(()))
    with pytest.raises(ValueError, match=r"base must be a ball of the same radius; got 0\.02 m and 0\.03 m"):
        build(Architecture.of("mlp", residual=True), radius=0.03, base=nominal_model(0.02))
