"""The impulse of a bounce: closed forms, conservation, and what friction may not do."""

from __future__ import annotations

import math

import pytest
import torch

from ballfg.dynamics import Impact
from ballfg.dynamics.motion.impact import BLEND, apply_impulse, slip_velocity

R = 0.02
SHELL = 2 / 3


def impact(velocity, spin, e=0.9, mu=0.25, e_t=0.0):
    as_tensor = lambda x: torch.as_tensor(x, dtype=torch.float64)  # noqa: E731
    return Impact(as_tensor(velocity), as_tensor(spin), as_tensor(e), as_tensor(mu), as_tensor(e_t))


@pytest.fixture
def random_impacts():
    rng = torch.Generator().manual_seed(1)
    velocity = torch.randn((500, 3), generator=rng, dtype=torch.float64) * 4
    velocity[:, 2] = -velocity[:, 2].abs() - 0.01
    spin = torch.randn((500, 3), generator=rng, dtype=torch.float64) * 200
    e, mu, e_t = (torch.rand((500, 1), generator=rng, dtype=torch.float64) for _ in range(3))
    return Impact(velocity, spin, e, mu, e_t)


def energy(velocity, spin, inertia):
    return 0.5 * velocity.square().sum(-1) + 0.5 * inertia * R**2 * spin.square().sum(-1)


def test_slip_is_the_velocity_of_the_lowest_point(random_impacts):
    lowest = torch.tensor((0.0, 0.0, -R), dtype=torch.float64)
    point = random_impacts.velocity + torch.linalg.cross(random_impacts.spin, lowest.expand_as(random_impacts.spin))
    torch.testing.assert_close(
        slip_velocity(random_impacts.velocity, random_impacts.spin, R), point[:, :2], rtol=0, atol=1e-13
    )


def test_sliding_by_hand():
    velocity, spin = apply_impulse(impact((6.0, 0.0, -2.0), (0.0, 0.0, 50.0)), R, SHELL)
    lost = 0.25 * 1.9 * 2.0  # mu (1 + e) |vz|, less than 2/5 of the slip 6 m/s
    torch.testing.assert_close(velocity, torch.tensor((6.0 - lost, 0.0, 1.8), dtype=torch.float64), rtol=0, atol=1e-14)
    torch.testing.assert_close(spin, torch.tensor((0.0, lost * 1.5 / R, 50.0), dtype=torch.float64), rtol=0, atol=1e-12)


def test_topspin_accelerates_and_backspin_brakes():
    topspin, _ = apply_impulse(impact((2.0, 0.0, -3.0), (0.0, 400.0, 0.0)), R, SHELL)
    backspin, _ = apply_impulse(impact((2.0, 0.0, -3.0), (0.0, -400.0, 0.0)), R, SHELL)
    assert topspin[0] > 2.0 > backspin[0]


def test_sidespin_does_not_push_and_stays():
    velocity, spin = apply_impulse(impact((0.0, 0.0, -3.0), (0.0, 0.0, 400.0)), R, SHELL)
    assert velocity.tolist() == pytest.approx([0.0, 0.0, 2.7], abs=1e-15)
    assert spin.tolist() == [0.0, 0.0, 400.0]


@pytest.mark.parametrize("inertia", [SHELL, 0.4, 1.0])
@pytest.mark.parametrize("e_t", [-1.0, 0.0, 0.4, 1.0])
def test_grip_turns_the_slip_round_by_e_t(inertia, e_t):
    before = impact((3.0, -1.0, -2.0), (30.0, 60.0, 5.0), mu=50.0, e_t=e_t)
    after = slip_velocity(*apply_impulse(before, R, inertia), R)
    torch.testing.assert_close(after, -e_t * slip_velocity(before.velocity, before.spin, R), rtol=0, atol=1e-13)


def test_grip_of_a_thin_shell_without_spin_keeps_three_fifths():
    velocity, spin = apply_impulse(impact((1.0, 0.0, -5.0), (0.0, 0.0, 0.0)), R, SHELL)
    assert float(velocity[0]) == pytest.approx(0.6, abs=1e-15)
    assert float(spin[1]) == pytest.approx(0.6 / R, abs=1e-12)  # rolls


@pytest.mark.parametrize("slip", [1.0, 10.0])
@pytest.mark.parametrize(
    ("factor", "stopped"),
    [(0.5, 0.5), (1 - BLEND, 1 - BLEND), (1.0, 1 - BLEND / 4), (1 + BLEND, 1.0), (2.0, 1.0)],
)
def test_slide_passes_into_grip_around_the_declared_condition(slip, factor, stopped):
    """mu (1 + e) |vz| = factor * 2/5 slip; the share of the slip that the impact stops is min(factor, 1), rounded."""
    vz = factor * 0.4 * slip / (0.25 * 1.9)
    velocity, spin = apply_impulse(impact((slip, 0.0, -vz), (0.0, 0.0, 0.0)), R, SHELL)
    assert float(slip_velocity(velocity, spin, R)[0]) == pytest.approx((1 - stopped) * slip, abs=1e-12)


def test_the_transition_has_no_kink():
    slip = torch.linspace(3.0, 8.0, 2001, dtype=torch.float64)
    velocity = torch.stack((slip, 0 * slip, 0 * slip - 4.0), dim=-1)
    after, _ = apply_impulse(impact(velocity, torch.zeros_like(velocity)), R, SHELL)
    slope = torch.diff(after[:, 0]) / torch.diff(slip)
    assert float(slope[0]) == pytest.approx(0.6, abs=1e-9)  # grips
    assert float(slope[-1]) == pytest.approx(1.0, abs=1e-9)  # slides
    assert float(torch.diff(slope).abs().max()) < 0.02


@pytest.mark.parametrize("inertia", [SHELL, 0.4])
def test_energy_never_increases(random_impacts, inertia):
    after = energy(*apply_impulse(random_impacts, R, inertia), inertia)
    before = energy(random_impacts.velocity, random_impacts.spin, inertia)
    assert bool((after <= before * (1 + 1e-14)).all())


def test_angular_momentum_about_the_contact_point_is_kept(random_impacts):
    velocity, spin = apply_impulse(random_impacts, R, SHELL)
    arm = torch.tensor((0.0, 0.0, R), dtype=torch.float64)

    def momentum(v, w):
        return torch.linalg.cross(arm.expand_as(v), v) + SHELL * R**2 * w

    torch.testing.assert_close(
        momentum(velocity, spin), momentum(random_impacts.velocity, random_impacts.spin), rtol=0, atol=1e-14
    )


def test_impulse_stays_in_the_friction_cone_and_opposes_the_slip(random_impacts):
    velocity, _ = apply_impulse(random_impacts, R, SHELL)
    tangential = (velocity - random_impacts.velocity)[:, :2]
    normal = velocity[:, 2:] - random_impacts.velocity[:, 2:]
    bound = random_impacts.friction * normal * (1 + 1e-12) + 1e-12
    assert bool((tangential.norm(dim=-1, keepdim=True) <= bound).all())
    slip = slip_velocity(random_impacts.velocity, random_impacts.spin, R)
    turned = tangential[:, 0] * slip[:, 1] - tangential[:, 1] * slip[:, 0]
    assert float(turned.abs().max()) < 1e-12 * 100
    assert bool(((tangential * slip).sum(-1) <= 0).all())


def test_slip_never_reverses_without_tangential_restitution(random_impacts):
    without = random_impacts.with_(tangential_restitution=torch.zeros((500, 1), dtype=torch.float64))
    after = slip_velocity(*apply_impulse(without, R, SHELL), R)
    before = slip_velocity(without.velocity, without.spin, R)
    assert bool(((after * before).sum(-1) >= -1e-12).all())


def test_a_ball_that_moves_away_gets_no_friction(model):
    state = torch.tensor([[0, 0, 0.02, 5, 0, 1, 0, 0, 0]], dtype=torch.float64)
    assert model.after_bounce(state)[0, 3].item() == 5.0
    assert energy(model.after_bounce(state)[:, 3:6], state[:, 6:], SHELL) <= energy(state[:, 3:6], state[:, 6:], SHELL)


@pytest.mark.parametrize("vz", [0.0, -1.0])
def test_first_and_second_derivatives_are_finite_without_slip(model, vz):
    state = torch.tensor([0, 0, 0.02, 0, 0, vz, 0, 0, 0], dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(model.after_bounce, state)
    hessian = torch.autograd.functional.hessian(lambda s: model.after_bounce(s).square().sum(), state)
    assert bool(jacobian.isfinite().all())
    assert bool(hessian.isfinite().all())


@pytest.mark.parametrize("speed", [0.5, 8.0])  # grips, slides
def test_gradcheck(model, speed):
    state = torch.tensor([[0.1, 0.2, 0.02, speed, 0.3, -2.0, 10.0, 20.0, 30.0]], dtype=torch.float64)
    state.requires_grad_(True)
    assert torch.autograd.gradcheck(model.after_bounce, (state,))
    assert torch.autograd.gradgradcheck(model.after_bounce, (state,))


def test_without_effects_a_bounce_only_turns_the_normal_speed(build, states):
    before = states(20)
    after = build().after_bounce(before)
    expected = before.clone()
    expected[:, 5] *= -1
    assert torch.equal(after, expected)
    assert math.isclose(float(build().surface_offset(before)), 0.0)
