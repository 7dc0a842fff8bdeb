"""Free flight against closed forms, against scipy, and its Jacobian against two other routes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch.autograd import forward_ad

from ballfg.dynamics.motion.flight_step import derivative, rk4_step
from ballfg.dynamics.motion.integrate import batch_jacobian, fly, fly_jacobian
from ballfg.dynamics.motion.limits import MAX_STEP, step_count


def seconds(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_without_air_the_path_is_a_parabola(build, states):
    start, dt = states(30), torch.linspace(-0.7, 1.3, 30, dtype=torch.float64)
    after = fly(build(gravity={"g": 9.81}), start, dt)
    g = seconds(0.0, 0.0, -9.81)
    t = dt[:, None]
    torch.testing.assert_close(after[:, :3], start[:, :3] + start[:, 3:6] * t + g * t**2 / 2, rtol=0, atol=1e-12)
    torch.testing.assert_close(after[:, 3:6], start[:, 3:6] + g * t, rtol=0, atol=1e-12)
    assert torch.equal(after[:, 6:], start[:, 6:])


@pytest.mark.parametrize(("k", "v0"), [(0.13, 5.0), (0.13, 20.0), (1.0, 3.0)])
def test_drag_alone_has_its_closed_form(build, k, v0):
    start = torch.zeros((1, 9), dtype=torch.float64)
    start[0, 3:6] = v0 * seconds(2, -1, 2) / 3
    t = 0.5
    after = fly(build(drag={"k": k}), start, seconds(t))
    # 25 steps; the error of each is a few (k v h)^5 / 120 of the speed, at most 1e-8
    assert after[0, 3:6].norm().item() == pytest.approx(v0 / (1 + k * v0 * t), rel=1e-7)
    assert after[0, :3].norm().item() == pytest.approx(math.log1p(k * v0 * t) / k, rel=5e-7)


def test_magnus_alone_makes_a_helix_at_constant_speed(build):
    k, w, v, rise, t = 0.003, 400.0, 6.0, 1.5, 0.8
    start = torch.zeros((1, 9), dtype=torch.float64)
    start[0, 3], start[0, 5], start[0, 8] = v, rise, w
    after = fly(build(magnus={"k": k}), start, seconds(t))[0]
    rate = k * w  # the velocity turns about the spin at k w
    expected = seconds(v / rate * math.sin(rate * t), v / rate * (1 - math.cos(rate * t)), rise * t)
    # 40 steps, each with an error of (k w h)^5 / 120 = 7e-11 of the speed and (k w h)^6 / 144 of its magnitude
    torch.testing.assert_close(after[:3], expected, rtol=0, atol=2e-8)
    assert after[3:6].norm().item() == pytest.approx(math.hypot(v, rise), abs=1e-9)


def test_spin_decays_exponentially_and_keeps_its_axis(build, states):
    start = states(5)
    after = fly(build(spin_decay={"rate": 0.7}), start, torch.full((5,), 0.9, dtype=torch.float64))
    torch.testing.assert_close(after[:, 6:], start[:, 6:] * math.exp(-0.63), rtol=1e-9, atol=0)


def test_all_effects_against_scipy(model, states):
    def rates(_, y):  # the equations, written again
        v, w = y[3:6], y[6:9]
        a = np.array((0, 0, -9.79)) - 0.13 * np.linalg.norm(v) * v + 0.0031 * np.cross(w, v)
        return np.concatenate((v, a, -0.3 * w))

    start = states(4)
    with torch.no_grad():
        after = fly(model, start, torch.full((4,), 0.6, dtype=torch.float64)).numpy()
    for row, y0 in zip(after, start.numpy(), strict=True):
        exact = solve_ivp(rates, (0, 0.6), y0, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(row[:3], exact[:3], rtol=0, atol=1e-7)
        np.testing.assert_allclose(row[3:6], exact[3:6], rtol=0, atol=5e-7)
        np.testing.assert_allclose(row[6:], exact[6:], rtol=1e-9, atol=0)


@pytest.mark.parametrize(("speed", "bound"), [(6.0, 5e-9), (20.0, 4e-7)])
def test_error_of_one_step_is_what_max_step_promises(model, states, speed, bound):
    start = states(50)
    start[:, 3:6] *= speed / start[:, 3:6].norm(dim=-1, keepdim=True)
    h = torch.full((50, 1), MAX_STEP, dtype=torch.float64)
    with torch.no_grad():
        fine = start
        for _ in range(16):
            fine = rk4_step(model.rates, fine, h / 16)
        error = (rk4_step(model.rates, start, h) - fine)[:, :3].abs().max()
    assert float(error) < bound


def test_order_of_convergence_is_four(model, states):
    start, total = states(10), 0.32

    def after(steps):
        x, h = start, torch.full((10, 1), total / steps, dtype=torch.float64)
        for _ in range(steps):
            x = rk4_step(model.rates, x, h)
        return x

    with torch.no_grad():
        exact = after(256)
        errors = [(after(n) - exact)[:, :6].norm() for n in (4, 8, 16)]
    for coarse, fine in itertools.pairwise(errors):
        assert 13 < float(coarse / fine) < 19


def test_back_in_time_returns_to_the_start(any_model, states):
    start, dt = states(20), torch.linspace(-0.1, 0.3, 20, dtype=torch.float64)
    torch.testing.assert_close(fly(any_model, fly(any_model, start, dt), -dt), start, rtol=0, atol=2e-5)


def test_each_row_keeps_its_own_dt(any_model, states):
    start, dt = states(6), seconds(0.001, 0.004, -0.01, 0.019, 0.0, 0.02)
    together = fly(any_model, start, dt)
    for i in range(6):
        torch.testing.assert_close(together[i], fly(any_model, start[i], dt[i]), rtol=0, atol=1e-13)


def test_leading_dimensions_broadcast(model, states):
    start = states(6)
    dt = torch.full((6,), 0.01, dtype=torch.float64)
    reference = fly(model, start, dt)
    torch.testing.assert_close(fly(model, start.reshape(2, 3, 9), dt[0]).reshape(6, 9), reference, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("longest", "steps"), [(0.0, 1), (0.02, 1), (0.0201, 2), (-0.05, 3), (1.0, 50), (float("nan"), 1)]
)
def test_step_count(longest, steps):
    assert step_count(seconds(0.001, longest)) == steps


def test_step_count_of_nothing_is_one():
    assert step_count(seconds()) == 1


def test_a_contact_that_never_comes_does_not_hide_long_intervals():
    assert step_count(seconds(float("nan"), 0.05)) == 3


def test_infinite_interval_is_refused():
    with pytest.raises(ValueError, match=r"dt must be finite; got inf"):
        step_count(seconds(float("inf")))


@pytest.mark.parametrize("dt", [0.0083, -0.015, 0.09])
def test_jacobian_by_three_routes(any_model, states, differences, dt):
    start, times = states(8), torch.full((8,), dt, dtype=torch.float64)
    after, jacobian = fly_jacobian(any_model, start, times)
    torch.testing.assert_close(after, fly(any_model, start, times).detach(), rtol=1e-15, atol=1e-14)
    _, by_autograd = batch_jacobian(lambda s: fly(any_model, s, times), start)
    torch.testing.assert_close(jacobian, by_autograd, rtol=1e-12, atol=1e-12)
    by_differences = differences(lambda s: fly(any_model, s, times), start)
    # positions round at 1e-16 over steps of 1e-3; spin columns have larger steps
    torch.testing.assert_close(jacobian, by_differences, rtol=1e-7, atol=1e-9)
    assert not jacobian.requires_grad


def test_jacobian_with_mixed_and_negative_dt(any_model, states):
    start, dt = states(5), seconds(0.07, -0.03, 0.0, 0.001, 0.02)
    _, jacobian = fly_jacobian(any_model, start, dt)
    _, by_autograd = batch_jacobian(lambda s: fly(any_model, s, dt), start)
    torch.testing.assert_close(jacobian, by_autograd, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(jacobian[2], torch.eye(9, dtype=torch.float64), rtol=0, atol=0)


def test_jacobian_of_gravity_alone(build, states):
    _, jacobian = fly_jacobian(build(gravity={}), states(2), seconds(0.01, 0.02))
    expected = torch.eye(9, dtype=torch.float64).repeat(2, 1, 1)
    for i, dt in enumerate((0.01, 0.02)):
        expected[i, :3, 3:6] = dt * torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("still", [torch.zeros(9, dtype=torch.float64), torch.eye(9, dtype=torch.float64)[2] * 0.5])
def test_derivatives_at_rest_are_finite(model, still):
    dt = seconds(0.01)
    _, jacobian = fly_jacobian(model, still[None], dt)
    hessian = torch.autograd.functional.hessian(lambda s: fly(model, s[None], dt).square().sum(), still)
    assert bool(jacobian.isfinite().all())
    assert bool(hessian.isfinite().all())


def test_drag_is_flat_at_rest(build):
    drag = build(drag={"k": 0.5})
    state = torch.zeros((1, 9), dtype=torch.float64)
    _, rates = batch_jacobian(lambda s: derivative(drag.rates, s), state)
    assert float(rates[0, 3:6].abs().max()) <= 1e-12  # 1/s


def test_gradcheck_by_state_time_and_parameters(model, states):
    start, dt = states(2).requires_grad_(True), seconds(0.03, -0.01).requires_grad_(True)
    names = [n for n, p in model.named_parameters() if n.startswith("flight")]
    values = tuple(dict(model.named_parameters())[n] for n in names)

    def after(start, dt, *_):
        return fly(model, start, dt) / torch.tensor((1, 1, 1, 1, 1, 1, 100, 100, 100.0), dtype=torch.float64)

    assert torch.autograd.gradcheck(after, (start, dt, *values))
    assert torch.autograd.gradgradcheck(after, (start, dt, *values), atol=1e-4, rtol=1e-4)


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's own
def test_tangents_are_carried_along_where_gradients_are_off(model, states):
    """Machine code knows no tangents: torch must do the work, though nothing is recorded for a way back."""
    start, dt = states(3), seconds(0.03, 0.2, -0.1)
    along = states(3, seed=1)
    with torch.no_grad(), forward_ad.dual_level():
        moved = forward_ad.unpack_dual(fly(model, forward_ad.make_dual(start, along), dt)).tangent
    _, jacobian = fly_jacobian(model, start, dt)
    assert moved is not None
    torch.testing.assert_close(moved, (jacobian @ along[..., None])[..., 0], rtol=1e-9, atol=1e-9)


def test_empty_batch(model):
    after, jacobian = fly_jacobian(model, torch.zeros((0, 9), dtype=torch.float64), seconds())
    assert after.shape == (0, 9)
    assert jacobian.shape == (0, 9, 9)


def test_batch_jacobian_finds_the_number_of_outputs(states):
    value, jacobian = batch_jacobian(lambda s: s[..., :2].square(), states(3))
    assert value.shape == (3, 2)
    expected = torch.zeros((3, 2, 9), dtype=torch.float64)
    expected[:, 0, 0], expected[:, 1, 1] = 2 * states(3)[:, 0], 2 * states(3)[:, 1]
    torch.testing.assert_close(jacobian, expected)


def test_no_ball_flies_nowhere(model):
    with torch.no_grad():
        assert fly(model, torch.zeros((0, 9), dtype=torch.float64), torch.zeros(0, dtype=torch.float64)).shape == (0, 9)
