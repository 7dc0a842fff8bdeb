"""Contact times on every branch, and the flow through contacts: values, Jacobians, Hessians."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from ballfg.dynamics.motion.contact import _newton_step, _scan, contact_time, fly_through, fly_through_jacobian
from ballfg.dynamics.motion.flight_step import derivative
from ballfg.dynamics.motion.integrate import batch_jacobian, fly
from ballfg.dynamics.motion.limits import LONGEST_FALL, MAX_STEP
from tests.dynamics import in_tensors

ROUTES = (fly_through_jacobian, in_tensors.fly_through_jacobian)
both_routes = pytest.mark.parametrize("through", ROUTES, ids=["torch", "arrays"])

R = 0.02


def rows(*states):
    return torch.tensor(states, dtype=torch.float64)


def test_small_steps_end_within_one_of_the_contact(build):
    """Forwards to where it comes down, back to where it went through, and the first of these where there are two."""
    model, g = build(gravity={"g": 9.81}), 9.81
    gaps, speeds = np.array([0.3, 0.3, -0.2]), np.array([-1.0, 2.0, -3.0])
    state = rows(*((0, 0, gap + R, 1, 0, vz, 0, 0, 0) for gap, vz in zip(gaps, speeds, strict=True)))
    exact = (speeds + np.sqrt(speeds**2 + 2 * g * gaps)) / g
    found = _scan(model, state, 0.0, torch.tensor([True, True, True]), 2.0)
    assert np.abs(found.numpy() - exact).max() <= MAX_STEP
    assert _scan(model, state, 0.0, torch.tensor([False, True, False]), 2.0).isnan().tolist() == [True, False, True]


@pytest.mark.parametrize("g", [9.81, 1.6, 25.0])
@pytest.mark.parametrize(
    ("gap", "vz"),
    [
        (0.3, -2.0),  # falls
        (0.3, 3.0),  # rises first
        (0.0, 1.0),  # has just left the surface
        (0.0, -1.0),  # touches now
        (-0.02, 2.0),  # comes up through the surface and down again
        (-0.001, 0.5),  # so slowly that it is near its apex
        (-0.02, -2.0),  # went through the surface a moment ago
        (1e-9, 0.0),  # grazes
        (60.0, 0.0),  # a long fall
    ],
)
def test_parabola(build, g, gap, vz):
    expected = (vz + math.sqrt(vz**2 + 2 * g * gap)) / g
    tau = contact_time(build(gravity={"g": g}), rows((0, 0, gap + R, 1, 0, vz, 0, 0, 0)), 0.0)
    assert tau.item() == pytest.approx(expected, rel=1e-11, abs=1e-10)


def test_heights_one_for_each_row(build):
    state = rows((0, 0, 0.5, 0, 0, 0, 0, 0, 0), (0, 0, 0.5, 0, 0, 0, 0, 0, 0))
    tau = contact_time(build(gravity={"g": 10.0}), state, torch.tensor([0.0, -0.76], dtype=torch.float64))
    assert tau.tolist() == pytest.approx([math.sqrt(0.096), math.sqrt(0.248)], abs=1e-13)


def test_offset_moves_the_surface(build):
    model = build(gravity={"g": 10.0}, table_height={"offset": 0.1})
    tau = contact_time(model, rows((0, 0, 0.5, 0, 0, 0, 0, 0, 0)), 0.0)
    assert tau.item() == pytest.approx(math.sqrt(2 * 0.38 / 10), abs=1e-13)


@pytest.mark.parametrize(
    "state",
    [
        (0, 0, -0.5, 0, 0, 0.1, 0, 0, 0),  # below the surface, cannot rise to it
        (0, 0, -0.5, 0, 0, -0.1, 0, 0, 0),  # below the surface, never was above
        (0, 0, -0.5, 3, 0, 0.0, 0, 50, 0),
        (0, 0, R - 1e-6, 0, 0, 0.0, 0, 0, 0),  # at its apex, a thousandth of a millimetre short
    ],
)
def test_no_contact_is_nan(model, state):
    assert math.isnan(contact_time(model, rows(state), 0.0 + 0.004).item())


def test_a_ball_without_weight_meets_what_it_flies_towards_and_nothing_else(build):
    state = rows((0, 0, 0.3, 0, 0, -1, 0, 0, 0), (0, 0, 0.3, 0, 0, 1, 0, 0, 0), (0, 0, 0.3, 0, 0, 0, 0, 0, 0))
    tau = contact_time(build(), state, 0.0)
    assert tau[0].item() == pytest.approx(0.28, abs=1e-13)
    assert tau[1:].isnan().all()


def test_a_contact_beyond_the_longest_fall_is_none(build):
    high = 5.0 * LONGEST_FALL**2
    assert contact_time(build(gravity={"g": 9.81}), rows((0, 0, high, 0, 0, 0, 0, 0, 0)), 0.0).isnan().all()


@pytest.mark.parametrize(
    ("k_drag", "k_magnus", "state"),
    [
        (0.12, 0.003, (0, 0, 0.3, 12, 0, 0.5, 0, -400, 0)),  # lift above the weight: rises before it falls
        (0.12, 0.003, (0, 0, R, 10, 0, 0.05, 0, -180, 0)),  # leaves the table almost without weight
        (0.12, 0.003, (0, 0, 0.3, 12, 0, -3.0, 0, -600, 0)),  # lift turns the falling ball round above the table
        (0.12, 0.003, (0, 0, 0.3, 12, 0, 0.0, 0, 600, 0)),  # pressed down
        (0.12, 0.003, (0, 0, R - 0.01, 10, 0, 0.35, 0, -200, 0)),  # lift brings it up where the weight alone would not
        (2.0, 0.0, (0, 0, 8.0, 5, 0, -6, 0, 0, 0)),  # strong drag, four seconds
        (0.12, 0.0, (0, 0, 40.0, 1, 0, 0, 0, 0, 0)),  # five seconds
    ],
)
def test_where_the_parabola_misleads(build, k_drag, k_magnus, state):
    def rates(_, y):  # the equations, written again
        v = y[3:]
        return np.concatenate((v, (0, 0, -9.81) - k_drag * np.linalg.norm(v) * v + k_magnus * np.cross(state[6:], v)))

    def crossing(_, y):
        return y[2] - R

    crossing.direction, crossing.terminal = -1, True
    exact = solve_ivp(rates, (0, 8), state[:6], "DOP853", events=crossing, rtol=1e-11, atol=1e-11, max_step=0.1).t[-1]
    model = build(gravity={}, drag={"k": k_drag}, magnus={"k": k_magnus})
    with torch.no_grad():
        # strong drag: 2 /m at 8 m/s makes steps of k v h = 0.3
        tolerance = 1e-4 if k_drag > 1 else 1e-6
        assert contact_time(model, rows(state), 0.0).item() == pytest.approx(exact, abs=tolerance)


def test_random_contacts_touch_and_fall(any_model, states):
    state = states(200)
    with torch.no_grad():
        tau = contact_time(any_model, state, 0.0)
        at = fly(any_model, state, tau)
        gap = any_model.gap(at, 0.0)
    assert tau.isfinite().all()
    assert float(gap.abs().max()) < 1e-12
    assert bool((at[:, 5] < 0).all())


def test_start_on_the_way_does_not_matter(any_model, states):
    state, back = states(50), torch.linspace(0.0, 0.05, 50, dtype=torch.float64)
    with torch.no_grad():
        tau = contact_time(any_model, state, 0.0)
        for shift in (-back, tau, tau + 0.01):  # earlier; at the contact; below the surface
            again = contact_time(any_model, fly(any_model, state, shift), 0.0)
            torch.testing.assert_close(again + shift, tau, rtol=0, atol=1e-6)


def test_values_do_not_depend_on_whether_a_graph_is_built(model, states):
    state = states(50)
    with torch.no_grad():
        plain = contact_time(model, state, 0.0)
    torch.testing.assert_close(contact_time(model, state.requires_grad_(True), 0.0).detach(), plain, rtol=0, atol=2e-14)


def test_one_lost_row_leaves_the_others_alone(model):
    state = rows((0, 0, 0.3, 5, 0, 0, 0, 0, 0), (0, 0, -0.5, 0, 0, 0.1, 0, 0, 0)).requires_grad_(True)
    dt = torch.full((2,), 0.3, dtype=torch.float64)
    after, times = fly_through(model, state, dt, (0.0,))
    assert times[1].isnan().all()
    assert after[1].isnan().all()
    gradient, by_drag = torch.autograd.grad(after[0].sum(), (state, model.flight["drag"].k))
    assert gradient.isfinite().all()
    assert by_drag.isfinite().all()
    alone, _ = fly_through(model, state[:1], dt[:1], (0.0,))
    torch.testing.assert_close(after[:1], alone)
    for through in ROUTES:
        after, times, jacobian = through(model, state, dt, (0.0,))
        assert times[1].isnan().all()
        assert jacobian[0].isfinite().all()


def test_gradient_of_the_contact_time_by_hand(build):
    """tau solves h + vz tau - g tau^2 / 2 = 0; its derivatives by h, vz, g are 1, tau, -tau^2 / 2, divided by |v'|."""
    model = build(gravity={"g": 9.81})
    state = rows((0, 0, 0.3, 1, 0, 0.7, 0, 0, 0)).requires_grad_(True)
    tau = contact_time(model, state, 0.0)
    by_state, by_g = torch.autograd.grad(tau.sum(), (state, model.flight["gravity"].g))
    impact_speed = math.sqrt(0.7**2 + 2 * 9.81 * 0.28)
    t = tau.item()
    assert by_state[0, 2].item() == pytest.approx(1 / impact_speed, rel=1e-12)
    assert by_state[0, 5].item() == pytest.approx(t / impact_speed, rel=1e-12)
    assert by_g.item() == pytest.approx(-(t**2) / (2 * impact_speed), rel=1e-12)


@both_routes
def test_saltation_formula(model, states, through):
    """At dt = tau the Jacobian is S F, with S = D + (f+ - D f-) e_z^T / vz-: D of the impact, f the rates."""
    state = states(10)
    with torch.no_grad():
        tau = contact_time(model, state, 0.0)
        before = fly(model, state, tau)
    after, impact = batch_jacobian(model.after_bounce, before)
    f_before, f_after = (derivative(model.rates, x).detach().unsqueeze(-1) for x in (before, after))
    row = torch.zeros((1, 9), dtype=torch.float64)
    row[0, 2] = 1.0
    saltation = impact + (f_after - impact @ f_before) @ row / before[:, 5, None, None]
    _, flight = batch_jacobian(lambda s: fly(model, s, tau), state)
    _, _, jacobian = through(model, state, tau, (0.0,))
    # the Jacobian is that of the Runge-Kutta steps to the contact, whose rate there is the true one but for their error
    torch.testing.assert_close(jacobian, saltation @ flight, rtol=1e-4, atol=1e-5)


@both_routes
@pytest.mark.parametrize("contacts", [0, 1, 2])
def test_jacobian_by_three_routes(any_model, states, differences, contacts, through):
    state = states(6)
    state[:, 2] -= 0.15
    dt = torch.linspace(0.05, 0.15, 6, dtype=torch.float64) + 0.3 * contacts  # contacts fall in and outside
    heights = (0.0,) * contacts
    after, times, jacobian = through(any_model, state, dt, heights)
    value, graph_times = fly_through(any_model, state, dt, heights)
    torch.testing.assert_close(after, value.detach(), rtol=0, atol=1e-10)
    torch.testing.assert_close(times, graph_times.detach(), rtol=0, atol=1e-11)

    def flow(s):
        batch = s.reshape(-1, 9)
        return fly_through(any_model, batch, dt.repeat(len(batch) // 6), heights)[0].reshape(s.shape)

    _, by_autograd = batch_jacobian(flow, state, outputs=9)
    # the composed Jacobian moves contacts along the differential equation, autograd along Runge-Kutta steps
    torch.testing.assert_close(jacobian, by_autograd, rtol=2e-6, atol=2e-6)
    by_differences = differences(flow, state)
    torch.testing.assert_close(by_autograd, by_differences, rtol=2e-6, atol=2e-7)


@both_routes
def test_jacobian_within_one_short_step_is_exact(any_model, states, differences, through):
    """In an interval of a camera's frame, as estimators use it: 1e-6 relative and far better."""
    state = states(20)
    with torch.no_grad():
        state = fly(any_model, state, contact_time(any_model, state, 0.0) - 0.005)
    dt = torch.full((20,), 0.0083, dtype=torch.float64)
    _, times, jacobian = through(any_model, state, dt, (0.0,))
    torch.testing.assert_close(times[:, 0], torch.full((20,), 0.005, dtype=torch.float64), rtol=0, atol=1e-9)
    numeric = differences(lambda s: fly_through(any_model, s, dt, (0.0,))[0], state)
    torch.testing.assert_close(jacobian, numeric, rtol=1e-7, atol=1e-7)


def test_heights_that_differ_and_contacts_outside_the_interval(model, states):
    """A contact before the start and one after the end: the flow is the smooth continuation."""
    state = states(5)
    with torch.no_grad():
        tau = contact_time(model, state, 0.0)
        reference, _ = in_tensors.fly_through(model, state, tau + 0.01, (0.0,))
        late = fly(model, state, tau + 0.004)  # already below the surface
        after, times = in_tensors.fly_through(model, late, torch.full((5,), 0.006, dtype=torch.float64), (0.0,))
        torch.testing.assert_close(after, reference, rtol=0, atol=1e-7)
        torch.testing.assert_close(times[:, 0], torch.full((5,), -0.004, dtype=torch.float64), rtol=0, atol=1e-8)
        early, _ = in_tensors.fly_through(model, state, tau - 0.003, (0.0,))
        bounced = model.after_bounce(fly(model, state, tau))
        backwards = fly(model, bounced, torch.full((5,), -0.003, dtype=torch.float64))
        torch.testing.assert_close(early, backwards, rtol=0, atol=1e-12)
        floor = torch.full((5,), -0.5, dtype=torch.float64)
        _, twice = in_tensors.fly_through(model, state, tau + 1.0, (0.0, floor))
    assert bool((twice[:, 1] > twice[:, 0]).all())


def loss_through(model, state, steps):
    """A scalar of the flow through one contact whose time took so many Newton steps with a graph."""
    with torch.no_grad():
        tau = contact_time(model, state, 0.0)
    for _ in range(steps):
        tau = tau + _newton_step(model, state, 0.0, tau)
    after = fly(model, model.after_bounce(fly(model, state, tau)), 0.25 - tau)
    weights = torch.tensor((1, 2, 3, 0.4, 0.5, 0.6, 0.01, 0.02, 0.03), dtype=torch.float64)
    return (after * weights).sum() + (after[..., :3].square()).sum()


def hessian(function, at):
    return torch.autograd.functional.hessian(function, at)


def numeric_hessian(function, at):
    """Central differences of the exact gradient, steps 1e-5 of each column's scale."""
    columns = []
    for j in range(9):
        step = torch.zeros(9, dtype=torch.float64)
        step[j] = (1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2)[j]
        plus, minus = (torch.autograd.functional.jacobian(function, at + sign * step) for sign in (1, -1))
        columns.append((plus - minus) / (2 * step[j]))
    return torch.stack(columns, dim=-1)


def test_two_newton_steps_give_the_exact_hessian_and_one_does_not(any_model, states):
    start = states(1)[0]

    def loss(steps):
        return lambda s: loss_through(any_model, s[None], steps)

    numeric = numeric_hessian(loss(2), start)
    scale = numeric.abs().max()
    assert float((hessian(loss(2), start) - numeric).abs().max() / scale) < 1e-7
    assert float((hessian(loss(1), start) - numeric).abs().max() / scale) > 1e-3
    gradients = [torch.autograd.functional.jacobian(loss(n), start) for n in (1, 2)]
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=1e-8)  # one is enough for a gradient


def test_hessian_of_fly_through(any_model, states):
    start, dt = states(1)[0], torch.tensor([0.4], dtype=torch.float64)
    start[2] -= 0.2

    def loss(s):
        return fly_through(any_model, s[None], dt, (0.0, 0.0))[0][..., :6].square().sum()

    numeric = numeric_hessian(loss, start)
    assert float((hessian(loss, start) - numeric).abs().max() / numeric.abs().max()) < 1e-6


def test_gradcheck_by_parameters_through_two_contacts(model, states):
    start, dt = states(1), torch.tensor([0.5], dtype=torch.float64)
    scale = torch.tensor((1, 1, 1, 1, 1, 1, 100, 100, 100), dtype=torch.float64)

    def after(*_):
        return fly_through(model, start, dt, (0.0, 0.0))[0] / scale

    assert torch.autograd.gradcheck(after, tuple(model.parameters()), eps=1e-6, atol=1e-5, rtol=1e-5)


def test_grazing_stays_finite(model):
    """A ball at its apex on the surface: the time is defined, its derivative large but finite."""
    state = rows((0, 0, R, 3, 0, 0.0, 0, 0, 0)).requires_grad_(True)
    tau = contact_time(model, state, 0.004)  # with the offset exactly at the apex
    assert tau.item() == pytest.approx(0.0, abs=1e-6)
    (gradient,) = torch.autograd.grad(tau.sum(), state)
    assert gradient.isfinite().all()


def test_a_named_contact_far_from_its_interval_is_none(build):
    model = build(gravity={"g": 10.0}, restitution={"e": 0.9})
    far = rows((0, 0, R + 0.8, 1, 0, 0, 0, 0, 0))  # touches after 0.4 s
    dt = torch.tensor([0.09, 0.11], dtype=torch.float64)
    for flow in (fly_through, in_tensors.fly_through, *ROUTES):
        times = flow(model, far.expand(2, 9), dt, (0.0,))[1]
        assert times[0].isnan().all()
        assert times[1].item() == pytest.approx(0.4, abs=1e-12)


@both_routes
def test_empty_batch(model, through):
    nothing = torch.zeros((0, 9), dtype=torch.float64)
    after, times, jacobian = through(model, nothing, nothing[:, 0], (0.0,))
    assert (after.shape, times.shape, jacobian.shape) == ((0, 9), (0, 1), (0, 9, 9))
