"""Motion with events: closed forms, an independent solver, rest, rolling, edges, and how time is cut."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from ballfg.dynamics import Surfaces, rollout
from ballfg.dynamics.model import substitute
from ballfg.dynamics.motion.contact import fly_through
from ballfg.dynamics.motion.impact import slip_velocity
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.motion.limits import REST_SPEED
from ballfg.dynamics.motion.rollout import LONGEST_MOTION, MAX_CONTACTS, advance, is_resting, place_on, roll

R = 0.02
TABLE_ONLY = Surfaces(0.0)


def rows(*states):
    return torch.tensor(states, dtype=torch.float64)


def seconds(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_bounces_in_vacuum_have_heights_e2_h(build):
    e, h, g = 0.9, 0.5, 9.81
    model = build(gravity={"g": g}, restitution={"e": e})
    fall = math.sqrt(2 * h / g)
    apexes = [fall * (1 + 2 * sum(e**i for i in range(1, n)) + e**n) for n in (1, 2, 3, 4)]
    with torch.no_grad():
        path = rollout(model, rows((0, 0, h + R, 1, 0, 0, 0, 0, 0)), seconds(*apexes), TABLE_ONLY)[0]
    for n, state in enumerate(path, start=1):
        assert state[2].item() - R == pytest.approx(e ** (2 * n) * h, abs=1e-12)
        assert state[5].item() == pytest.approx(0.0, abs=1e-12)
        assert state[0].item() == pytest.approx(apexes[n - 1], abs=1e-12)


@pytest.mark.parametrize(
    ("spin", "bounces"),
    [((0.0, 0.0, 0.0), 2), ((20.0, 300.0, -50.0), 2), ((0.0, -250.0, 100.0), 1)],
    ids=["none", "topspin", "backspin"],
)
def test_bounces_against_scipy(build, spin, bounces):
    g, k, m, e, mu = 9.81, 0.12, 0.0028, 0.92, 0.25

    def rates(_, y):  # the equations, written again
        v, w = y[3:6], y[6:9]
        return np.concatenate((v, (0, 0, -g) - k * np.linalg.norm(v) * v + m * np.cross(w, v), np.zeros(3)))

    def crossing(_, y):
        return y[2] - R

    crossing.direction, crossing.terminal = -1, True

    def bounced(y):
        y = y.copy()
        v, w = y[3:6], y[6:9]
        slip = v + np.cross(w, (0, 0, -R))
        slide = mu * (1 + e) * -v[2] / np.linalg.norm(slip[:2])
        share, width = min(slide, 0.4), 0.1 * 0.4  # the transition's half width is a tenth of the gripping impulse
        share -= max(0.0, width - abs(slide - 0.4)) ** 2 / (4 * width)
        impulse = -share * np.array((slip[0], slip[1], 0.0))
        y[6:9] += np.cross((0, 0, -R), impulse) / (2 / 3 * R**2)
        y[3:6] += impulse
        y[5] = -e * v[2] if v[2] < 0 else y[5]
        return y

    y, t, end = np.array((0, 0, 0.3, 5, 0.5, 0.5, *spin)), 0.0, 0.7
    contacts = 0
    while t < end:
        solved = solve_ivp(rates, (t, end), y, "DOP853", events=crossing, rtol=1e-11, atol=1e-12)
        t, y = solved.t[-1], solved.y[:, -1]
        if solved.status == 1:
            y, contacts = bounced(y), contacts + 1
    assert contacts == bounces
    model = build(gravity={"g": g}, drag={"k": k}, magnus={"k": m}, restitution={"e": e}, friction={"mu": mu})
    start = rows((0, 0, 0.3, 5, 0.5, 0.5, *spin))
    with torch.no_grad():
        after = rollout(model, start, torch.arange(1, 71, dtype=torch.float64) / 100, TABLE_ONLY)[0, -1].numpy()
    np.testing.assert_allclose(after[:6], y[:6], rtol=0, atol=2e-7)
    np.testing.assert_allclose(after[6:], y[6:], rtol=0, atol=2e-5)


def test_advance_is_fly_through_when_the_contact_is_inside(model, states):
    state, dt = states(20), torch.full((20,), 0.02, dtype=torch.float64)
    with torch.no_grad():
        state[:, 2], state[:, 5] = 0.03, -2.0
        expected, times = fly_through(model, state, dt, (0.0,))
        assert bool(((times > 0) & (times < 0.02)).all())
        torch.testing.assert_close(advance(model, state, dt, TABLE_ONLY), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("pieces", [2, 7, 40])
def test_time_may_be_cut_anywhere(model, states, pieces):
    state = states(6)
    total = 0.6  # one to three bounces; equal steps on both sides keep Runge-Kutta's own error out of it
    with torch.no_grad():
        whole = advance(model, state, torch.full((6,), total, dtype=torch.float64), TABLE_ONLY)
        cuts = torch.linspace(0, total, 31 * 20 + 1, dtype=torch.float64)[1:]
        cuts = cuts[:: max(1, len(cuts) // pieces)]
        path = rollout(model, state, torch.cat((cuts, seconds(total))), TABLE_ONLY)[:, -1]
    torch.testing.assert_close(path[:, :6], whole[:, :6], rtol=0, atol=5e-6)
    torch.testing.assert_close(path[:, 6:], whole[:, 6:], rtol=1e-5, atol=1e-3)


def test_time_may_be_cut_anywhere_without_air(build, states):
    """Without air a Runge-Kutta step of any size is exact, so that the events alone are compared."""
    model = build(gravity={}, restitution={"e": 0.8}, friction={"mu": 0.25})
    state = states(6)
    with torch.no_grad():
        whole = advance(model, state, torch.full((6,), 1.1, dtype=torch.float64), TABLE_ONLY)
        path = rollout(model, state, torch.linspace(0, 1.1, 173, dtype=torch.float64), TABLE_ONLY)[:, -1]
    torch.testing.assert_close(path, whole, rtol=0, atol=1e-9)


@pytest.mark.parametrize("speed", [REST_SPEED * 0.9, REST_SPEED * 1.05, REST_SPEED * 1.5, 0.2])
def test_small_hops_do_not_depend_on_how_time_is_cut(build, speed):
    model = build(gravity={}, restitution={"e": 0.8})
    state = rows((0, 0, R, 1, 0, speed, 0, 0, 0))
    with torch.no_grad():
        whole = rollout(model, state, seconds(0.02, 0.04, 0.06), TABLE_ONLY)[:, -1]
        path = rollout(model, state, torch.linspace(0, 0.06, 301, dtype=torch.float64), TABLE_ONLY)[:, -1]
    # friction of rolling decays at 30 1/s: Runge-Kutta's error over 20 ms is (0.6)^5 / 120 of a small slip
    torch.testing.assert_close(path, whole, rtol=0, atol=1e-5)
    torch.testing.assert_close(path[:, [2, 5]], whole[:, [2, 5]], rtol=0, atol=1e-12)


def test_one_ball_and_many_give_the_same(any_model, states):
    state, dt = states(8), torch.full((8,), 0.25, dtype=torch.float64)
    with torch.no_grad():
        together = advance(any_model, state, dt, TABLE_ONLY)
        for i in range(8):
            alone = advance(any_model, state[i : i + 1], dt[i : i + 1], TABLE_ONLY)
            torch.testing.assert_close(together[i : i + 1], alone, rtol=1e-12, atol=1e-12)


def test_own_parameters_for_each_row(model, states):
    state, dt = states(5), torch.full((5,), 0.4, dtype=torch.float64)
    values = {
        "flight.drag.k": torch.linspace(0.0, 0.3, 5, dtype=torch.float64)[:, None],
        "flight.gravity.g": torch.linspace(9, 11, 5, dtype=torch.float64)[:, None],
        "bounce.restitution.e": torch.linspace(0.5, 0.9, 5, dtype=torch.float64)[:, None],
        "bounce.friction.mu": torch.linspace(0.1, 0.4, 5, dtype=torch.float64)[:, None],
        "bounce.table_height.offset": torch.linspace(-0.01, 0.01, 5, dtype=torch.float64)[:, None],
    }
    with torch.no_grad():
        together = advance(substitute(model, values), state, dt, TABLE_ONLY)
        for i in range(5):
            own = substitute(model, {name: value[i, 0] for name, value in values.items()})
            alone = advance(own, state[i : i + 1], dt[i : i + 1], TABLE_ONLY)
            torch.testing.assert_close(together[i : i + 1], alone, rtol=1e-12, atol=1e-12)


def test_several_contacts_within_one_step(build):
    model = build(gravity={}, restitution={"e": 0.8})
    v = 0.09  # returns after 18 ms, leaves at 0.072, after 15 ms more at 0.058, then would leave at 0.046: rests
    state = rows((0, 0, R, 0.5, 0, v, 0, 0, 0), (0, 0, R + 1e-4, 0.5, 0, -0.08, 0, 0, 0))
    g = 9.81
    with torch.no_grad():
        after = advance(model, state, seconds(0.02, 0.02), TABLE_ONLY)
    left, t = 0.8 * v, 0.02 - 2 * v / g
    assert after[0, 2].item() - R == pytest.approx(left * t - g * t**2 / 2, abs=1e-12)
    impact = math.sqrt(0.08**2 + 2 * g * 1e-4)
    t = 0.02 - (impact - 0.08) / g  # left after the first touch, which leaves at 0.8 * impact
    second = t - 2 * 0.8 * impact / g
    assert second > 0
    left = 0.64 * impact  # leaves a second time, above REST_SPEED
    assert left > REST_SPEED
    assert after[1, 2].item() - R == pytest.approx(left * second - g * second**2 / 2, abs=1e-12)


def test_more_contacts_than_allowed_end_in_rest(build):
    model = build(gravity={"g": 30.0}, magnus={"k": 0.1}, restitution={"e": 1.0})
    state = rows((0, 0, R, 20, 0, 0.051, 0, 500, 0))  # pressed down by 1000 m/s^2: a hop takes 0.1 ms
    with torch.no_grad():
        after = advance(model, state, seconds(0.02), TABLE_ONLY)
    assert MAX_CONTACTS < 0.02 / 1e-4
    assert after[0, 2].item() == pytest.approx(R, abs=1e-12)
    assert after[0, 5].item() == 0.0


def test_a_ball_at_rest_stays_on_the_surface_exactly(model):
    state = rows((0.3, 0.2, R - 0.004, 0, 0, 0, 0, 0, 0))
    with torch.no_grad():
        path = rollout(model, state, torch.linspace(0, 1, 11, dtype=torch.float64), TABLE_ONLY)
    torch.testing.assert_close(path, state[:, None].expand_as(path), rtol=0, atol=1e-15)


def test_a_bouncing_ball_comes_to_rest_and_then_rolls(model):
    state = rows((0, 0, 0.1, 0.5, 0.2, 0, 0, 0, 0))
    with torch.no_grad():
        end = rollout(model, state, torch.linspace(0, 4, 81, dtype=torch.float64), TABLE_ONLY)[:, -1]
        assert model.gap(end, 0.0).item() == pytest.approx(0.0, abs=1e-15)
    assert end[0, 5].item() == 0.0
    slip = slip_velocity(end[:, 3:6], end[:, 6:], R)
    assert float(slip.norm()) < 0.01 * float(end[:, 3:5].norm())


def test_a_sliding_thin_shell_rolls_at_three_fifths(build):
    state = rows((0, 0, R, 2.0, 0, 0, 0, 0, 0))
    with torch.no_grad():
        after = advance(build(gravity={}), state, seconds(0.5), TABLE_ONLY)
    speed = after[0, 3].item()
    assert speed == pytest.approx(1.2 - 0.01 * 9.81 * 0.5, abs=0.01)  # less what rolling resistance takes
    assert after[0, 7].item() * R == pytest.approx(speed, rel=0.02)
    assert after[0, 2].item() == R


def test_rolling_loses_speed_but_keeps_rolling_to_a_stop(build):
    state = rows((0, 0, R, 0.5, 0, 0, 0, 25.0, 0))
    with torch.no_grad():
        path = rollout(build(gravity={}), state, torch.linspace(0, 30, 11, dtype=torch.float64), TABLE_ONLY)[0]
    assert bool((torch.diff(path[:, 3]) < 0).all())
    assert abs(path[-1, 3].item()) < 1e-4
    torch.testing.assert_close(path[:, 7] * R, path[:, 3], rtol=0, atol=1e-6)


def test_lift_above_the_weight_takes_a_resting_ball_off(build):
    model = build(gravity={}, magnus={"k": 0.003}, restitution={"e": 0.9})
    state = rows((0, 0, R, 10, 0, 0, 0, -500, 0), (0, 0, R, 10, 0, 0, 0, -100, 0))
    with torch.no_grad():
        after = advance(model, state, seconds(0.02, 0.02), TABLE_ONLY)
    assert after[0, 2].item() > R + 5e-4
    assert after[1, 2].item() == R


def test_starting_a_little_below_and_falling_means_the_bounce_was_a_moment_ago(model, states):
    above = states(10)
    above[:, 2], above[:, 5] = 0.05, -2.0
    with torch.no_grad():
        above[:, 2] -= model.gap(above, 0.0) - 0.002
        below = fly(model, above, torch.full((10,), 0.004, dtype=torch.float64))
        assert bool((model.gap(below, 0.0) < 0).all())
        late = advance(model, below, torch.full((10,), 0.006, dtype=torch.float64), TABLE_ONLY)
        reference = advance(model, above, torch.full((10,), 0.01, dtype=torch.float64), TABLE_ONLY)
    torch.testing.assert_close(late, reference, rtol=1e-6, atol=1e-6)


def test_starting_below_and_rising_leaves(build):
    state = rows((0, 0, R - 0.005, 1, 0, 1.5, 0, 0, 0))
    with torch.no_grad():
        after = advance(build(gravity={"g": 10.0}), state, seconds(0.02), TABLE_ONLY)
    assert after[0, 2].item() == pytest.approx(R - 0.005 + 0.03 - 0.002, abs=1e-14)


def test_starting_below_and_too_slow_to_come_up_is_put_at_rest(build):
    state = rows((0, 0, R - 0.01, 1, 0, 0.1, 0, 0, 0), (0, 0, R - 0.01, 1, 0, -0.1, 0, 0, 0))
    with torch.no_grad():
        after = advance(build(gravity={}, restitution={"e": 0.9}), state, seconds(0.1, 0.1), TABLE_ONLY)
    assert after[:, 2].tolist() == [R, R]
    assert after[:, 5].tolist() == [0.0, 0.0]


def test_a_ball_beside_the_table_falls_to_the_floor(build, table):
    model = build(gravity={"g": 9.81}, restitution={"e": 0.5})
    state = rows((0, 0, -0.1, 0, 0, 0, 0, 0, 0))
    fall = math.sqrt(2 * (0.66 - R) / 9.81)
    with torch.no_grad():
        after = advance(model, state, seconds(fall * 2), table)
    assert after[0, 2].item() == pytest.approx(-0.76 + R + 0.5 * 9.81 * fall * fall - 9.81 * fall**2 / 2, abs=1e-12)


def test_without_a_floor_it_falls_on(build):
    with torch.no_grad():
        after = advance(build(gravity={"g": 10.0}), rows((0, 0, -0.1, 0, 0, 0, 0, 0, 0)), seconds(1.0), TABLE_ONLY)
    assert after[0, 2].item() == pytest.approx(-5.1, abs=1e-12)


EXTENT = Surfaces(0.0, -0.76, (0.0, 2.74, -0.8, 0.8))


@pytest.mark.parametrize("pieces", [1, 3, 50])
@pytest.mark.parametrize(
    ("x", "vx", "bounces"),
    [(-0.05, 8.0, True), (-0.15, 8.0, False), (2.70, 1.0, True), (2.73, 1.0, False), (1.0, 0.0, True)],
)
def test_the_place_of_the_touch_decides(build, pieces, x, vx, bounces):
    model = build(gravity={}, restitution={"e": 0.9})
    state = rows((x, 0, 0.12, vx, 0, -6, 0, 0, 0))  # touches after 16 ms
    with torch.no_grad():
        path = rollout(model, state, torch.linspace(0, 0.06, pieces + 1, dtype=torch.float64), EXTENT)
    assert (path[0, -1, 5].item() > 0) == bounces


def test_a_ball_that_rolls_over_the_edge_falls_to_the_floor_and_bounces_there(build):
    model = build(gravity={}, restitution={"e": 0.8})
    state = rows((2.70, 0, R, 1.0, 0, 0, 0, 50.0, 0))
    with torch.no_grad():
        path = rollout(model, state, torch.linspace(0, 0.6, 121, dtype=torch.float64), EXTENT)[0]
    assert path[5, 2].item() == R  # on the table
    assert path[60, 2].item() < -0.05  # beside it
    assert path[:, 2].min().item() > -0.76 + R - 1e-9
    assert path[-1, 5].item() > 0  # up from the floor


def test_gradient_through_two_bounces(model, states):
    start = states(1).requires_grad_(True)
    scale = torch.tensor((1, 1, 1, 1, 1, 1, 100, 100, 100), dtype=torch.float64)

    def after(s, *_):
        return advance(model, s, seconds(0.55), TABLE_ONLY) / scale

    parameters = tuple(model.parameters())
    assert torch.autograd.gradcheck(after, (start, *parameters), eps=1e-6, atol=2e-5, rtol=1e-4)


def test_gradient_of_resting_and_lost_balls_is_finite(model):
    state = rows(
        (0, 0, R - 0.004, 0, 0, 0, 0, 0, 0), (0, 0, R - 0.01, 1, 0, -0.1, 0, 0, 0), (0, 0, 0.03, 0, 0, -0.5, 0, 0, 0)
    ).requires_grad_(True)
    after = advance(model, state, seconds(0.05, 0.05, 0.05), TABLE_ONLY)
    gradients = torch.autograd.grad(after.square().sum(), (state, *model.parameters()))
    assert all(bool(g.isfinite().all()) for g in gradients)


def test_roll_and_place_on(model):
    state = rows((0.1, 0.2, 0.5, 1.0, -0.5, 3.0, 1, 2, 3))
    with torch.no_grad():
        placed = place_on(model, state, 0.2)
        assert placed[0, 2].item() == pytest.approx(0.2 - 0.004 + R, abs=1e-15)
        assert placed[0, 5].item() == 0.0
        assert is_resting(model, placed, 0.2).all()
        rolled = roll(model, state, seconds(0.05), 0.2)
        assert is_resting(model, rolled, 0.2).all()
        assert not is_resting(model, state, 0.2).any()
    assert placed[0, [0, 1, 3, 4, 6, 7, 8]].tolist() == state[0, [0, 1, 3, 4, 6, 7, 8]].tolist()


def test_empty_batch(model):
    nothing = torch.zeros((0, 9), dtype=torch.float64)
    assert advance(model, nothing, nothing[:, 0], TABLE_ONLY).shape == (0, 9)


@pytest.mark.parametrize("dt", [-0.01, math.nan, math.inf])
def test_bad_dt_is_refused(model, states, dt):
    got = r"got (-0\.01|nan|0\.01) to (0\.01|nan|inf) s"
    with pytest.raises(ValueError, match=rf"dt must be finite and not negative; {got}\. Sort the times\."):
        advance(model, states(2), seconds(0.01, dt), TABLE_ONLY)


@pytest.mark.parametrize("times", [(0.1, 0.05), (-0.1, 0.2), (0.1, math.nan)])
def test_bad_times_are_refused(model, states, times):
    with pytest.raises(ValueError, match=r"times must start at 0 or later and must not decrease\. Sort them\."):
        rollout(model, states(2), seconds(*times), TABLE_ONLY)


def test_rollout_takes_common_times_and_own_times(model, states):
    state = states(2)
    times = torch.tensor([[0.0, 0.1, 0.1], [0.05, 0.2, 0.3]], dtype=torch.float64)
    with torch.no_grad():
        own = rollout(model, state, times, TABLE_ONLY)
        assert own.shape == (2, 3, 9)
        assert torch.equal(own[0, 0], state[0])
        assert torch.equal(own[0, 1], own[0, 2])
        common = rollout(model, state[1:], times[1], TABLE_ONLY)
    torch.testing.assert_close(own[1:], common, rtol=0, atol=1e-9)


def test_a_ball_stays_where_it_is_after_the_longest_motion(model) -> None:
    start = torch.tensor([[0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    surfaces = Surfaces(0.0)
    with torch.no_grad():
        by_then = advance(model, start, torch.tensor([LONGEST_MOTION], dtype=torch.float64), surfaces)
        later = advance(model, start, torch.tensor([1e6], dtype=torch.float64), surfaces)
    torch.testing.assert_close(later, by_then, rtol=0.0, atol=0.0)
    assert by_then[0, 3:6].norm() < 0.05  # it hardly moves any more


@pytest.mark.parametrize(
    "surfaces",
    [Surfaces.table_tennis(0.0), Surfaces(0.0, -0.76, (0.0, 2.74, -0.76, 0.76)), Surfaces(0.0), Surfaces(-9.0)],
)
@pytest.mark.parametrize("dt", [0.0, 0.004, 0.05])
def test_machine_code_goes_from_time_to_time_as_torch_does(any_model, states, surfaces, dt) -> None:
    """Through bounces, over edges, into rest; `advance` takes the same steps one at a time."""
    start, times = states(9), 0.01 + dt * torch.arange(60, dtype=torch.float64)
    with torch.no_grad():
        found = rollout(any_model, start, times, surfaces)
        state = start
        for k, step in enumerate(torch.diff(times, prepend=torch.zeros(1, dtype=torch.float64))):
            state = advance(any_model, state, step.expand(9), surfaces)
            torch.testing.assert_close(found[:, k], state, rtol=1e-12, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("edges", [None, (-1.0, 9.0, -1.0, 1.0)], ids=["endless", "edged"])
@pytest.mark.parametrize("differentiated", [False, True])
def test_a_table_may_lie_far_below_its_declared_height(build, differentiated, edges):
    """The centre of a ball that touches it is lower than that height, and yet the ball is above the table."""
    declared = {"gravity": {"g": 9.81}, "drag": {"k": 0.1}, "restitution": {"e": 0.9}, "friction": {"mu": 0.2}}
    low, usual, surfaces = (
        build(**declared, table_height={"offset": -0.05}),
        build(**declared),
        Surfaces(0.7, 0.0, edges),
    )
    times, lower = torch.linspace(0.1, 1.2, 12, dtype=torch.float64), seconds(0, 0, 0.05, 0, 0, 0, 0, 0, 0)
    start = rows((0, 0, 1.0, 2, 0.1, 0, 0, 50, 0))
    with torch.set_grad_enabled(differentiated):
        expected = rollout(usual, start, times, surfaces).detach()
        found = rollout(low, start - lower, times, surfaces).detach()
    assert float(found[0, -1, 5]) > -3.0  # it has bounced: a free fall is at 11 m/s
    torch.testing.assert_close(found, expected - lower, rtol=0, atol=1e-9)


@pytest.mark.parametrize("differentiated", [False, True])
def test_a_ball_bounces_where_a_leaning_table_is_low(build, differentiated):
    """2 m from the origin a table that leans by 2.3 degrees is 80 mm lower. Without losses, energy stays the same."""
    leaning = build(gravity={"g": 9.81}, restitution={"e": 1.0}, table_tilt={"x": 0.0, "y": 0.04})
    times, start = torch.linspace(0.02, 0.6, 30, dtype=torch.float64), rows((2.0, 0, 1.0, 1, 0, 0, 0, 0, 0))
    with torch.set_grad_enabled(differentiated):
        (path,) = rollout(leaning, start, times, Surfaces(0.7, 0.0, (-1.0, 9.0, -1.0, 1.0))).detach()
    energy = 9.81 * path[:, 2] + 0.5 * path[:, 3:6].square().sum(-1)
    torch.testing.assert_close(energy, torch.full_like(energy, 9.81 + 0.5), rtol=0, atol=1e-9)
    assert bool((leaning.gap(path, 0.7) > -1e-9).all())
    assert float(path[-1, 5]) < float(path[:, 5].max()) > 2.0
    assert path[:, 2].min() < 0.7
