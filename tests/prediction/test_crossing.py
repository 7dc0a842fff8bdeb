"""Apex, contact, plane: against dense rollouts, and their covariance against Monte Carlo on the event's surface."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces
from ballfg.dynamics.motion.contact import contact_time
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.motion.rollout import advance, rollout
from ballfg.prediction import Propagator, apex, next_contact, next_crossing, plane_crossing
from ballfg.state import STATE_DIM, VZ, Z

FALLING = [0.0, 0.0, 0.25, 4.0, 0.3, -1.0, 10.0, 30.0, 5.0]
RISING = [0.0, 0.0, 0.25, 4.0, 0.3, 2.0, 10.0, 30.0, 5.0]
CENTRE = 0.016  # m, z of a ball that lies on the table of the fixture `model`
EDGE = Surfaces(0.0, -0.76, extent=(-1.0, 1.0, -0.7, 0.7))
X = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)


def dense(model, state, surfaces, end=1.5, step=1e-3):
    """Times (k,) and states (k, 9) every millisecond."""
    times = torch.arange(0.0, end, step, dtype=torch.float64)
    with torch.no_grad():
        return times, rollout(model, torch.tensor([state], dtype=torch.float64), times, surfaces)[0]


def zero(times, values, rank=0, rising=False):
    """Time at which sampled values fall through zero, by a line between samples 1 ms apart: good to 1e-6 s."""
    values = -values if rising else values
    i = int(((values[:-1] > 0) & (values[1:] <= 0)).nonzero()[rank])
    return float(times[i] + (times[i + 1] - times[i]) * values[i] / (values[i] - values[i + 1]))


# --- where and when ----------------------------------------------------------------------------------------------


def test_apex_before_and_after_bounces(model, beliefs, table):
    times, states = dense(model, RISING, table.surfaces)
    belief = beliefs(model, RISING)
    found = apex(table, belief)
    contact = next_contact(table, belief)
    after_first = apex(table, belief, after=contact.time)
    second = next_contact(table, belief, after=contact.time)
    after_second = apex(table, belief, after=second.time)
    for rank, crossing in enumerate((found, after_first, after_second)):
        assert crossing.time == pytest.approx(zero(times, states[:, VZ], rank), abs=2e-6)
        assert abs(crossing.state[VZ]) < 1e-11
    assert found.time < contact.time < after_first.time < second.time < after_second.time
    assert apex(table, beliefs(model, FALLING)).time > next_contact(table, beliefs(model, FALLING)).time


def test_clocks_of_any_origin(model, beliefs, table):
    """Stamps in seconds since 1970 are rounded to 2e-7 s; no event is lost or found twice."""
    late, near = (beliefs(model, RISING, time=origin) for origin in (1.7e9, 0.0))
    after, other = -math.inf, -math.inf
    for _ in range(3):
        for event in (apex, next_contact):
            found, expected = event(table, late, after=after), event(table, near, after=other)
            assert found.time - 1.7e9 == pytest.approx(expected.time, abs=1e-5)
            assert found.time_sigma == pytest.approx(expected.time_sigma, rel=1e-3)
            after, other = found.time, expected.time


@pytest.mark.parametrize("cut", [0.02, 0.02 - 1e-9, 0.2, 0.1])
def test_events_at_the_end_of_a_step_are_found(gravity, beliefs, table, cut):
    """The apex, the contact and the plane lie exactly where the search passes from one step to the next."""
    rising = beliefs(gravity, [0, 0, 0.5, 1.0, 0, 9.81 * cut, 0, 0, 0])
    assert apex(table, rising).time == pytest.approx(cut, abs=1e-12)
    assert plane_crossing(table, rising, X, cut).time == pytest.approx(cut, abs=1e-12)
    falling = beliefs(gravity, [0, 0, 0.02 + cut + 9.81 * cut**2 / 2, 1.0, 0, -1.0, 0, 0, 0])
    assert next_contact(table, falling).time == pytest.approx(cut, abs=1e-12)


def test_contact_is_where_the_rollout_turns(model, beliefs, table):
    for start in (RISING, FALLING):
        times, states = dense(model, start, table.surfaces)
        first = int((torch.diff(states[:, VZ]) > 1).nonzero()[0])
        found = next_contact(table, beliefs(model, start, time=10.0))
        assert 10 + times[first] <= found.time <= 10 + times[first + 1]
        assert float(found.state[Z]) == pytest.approx(CENTRE, abs=1e-12)
        assert found.state[VZ] < -2.0  # just before the bounce
        np.testing.assert_allclose(found.state, states[first], atol=0.02, rtol=0.01)


@pytest.mark.parametrize("place", [0.3, 0.6, 1.0, 2.5])
def test_plane_across_the_flight(model, beliefs, table, place):
    """A plane before, near and after bounces (at x = 0.57 and 1.9 m), its normal of any length and sign."""
    times, states = dense(model, FALLING, table.surfaces)
    found = plane_crossing(table, beliefs(model, FALLING), X, place)
    assert found.time == pytest.approx(zero(times, states[:, 0] - place, rising=True), abs=2e-6)
    assert float(found.state[0]) == pytest.approx(place, abs=1e-10)
    assert np.abs(found.covariance[0]).max() < 1e-12
    other = plane_crossing(table, beliefs(model, FALLING), -2 * X, -2 * place)
    assert (other.time, other.time_sigma) == (pytest.approx(found.time), pytest.approx(found.time_sigma))


def test_plane_at_the_contact_itself(model, beliefs, table):
    belief = beliefs(model, FALLING)
    contact = next_contact(table, belief)
    found = plane_crossing(table, belief, X, float(contact.state[0]))
    assert found.time == pytest.approx(contact.time, abs=1e-9)


def test_horizontal_plane_from_both_sides(model, beliefs, table):
    """0.1 m up: down through it, up after the bounce, down again."""
    up = torch.tensor([0.0, 0.0, 1.0])
    times, states = dense(model, FALLING, table.surfaces)
    height = states[:, Z] - 0.1
    found, after = [], -math.inf
    for _ in range(3):
        crossing = plane_crossing(table, beliefs(model, FALLING), up, 0.1, after=after)
        found.append(crossing.time)
        after = crossing.time
    expected = [zero(times, height), zero(times, height, rising=True), zero(times, height, 1)]
    assert found == pytest.approx(expected, abs=5e-6)


def test_a_start_on_the_plane_is_past(model, beliefs, table):
    up = torch.tensor([0.0, 0.0, 1.0])
    found = plane_crossing(table, beliefs(model, RISING), up, RISING[Z])
    assert found.time > 0.3
    assert found.state[VZ] < 0
    assert plane_crossing(table, beliefs(model, FALLING), X, 0.0) is None


def test_apex_at_the_start_is_past(model, beliefs, table):
    dropped = [0, 0, 0.25, 0, 0, 0.0, 0, 0, 0]
    belief = beliefs(model, dropped)
    contact = next_contact(table, belief)
    assert apex(table, belief).time > contact.time
    assert contact.time == pytest.approx(math.sqrt(2 * (0.25 - CENTRE) / 9.81), abs=3e-3)


def test_contact_at_the_start_is_past(model, beliefs, table):
    at_contact = [0, 0, CENTRE, 3, 0, -2, 0, 0, 0]
    below = [0, 0, CENTRE - 0.002, 3, 0, -2, 0, 0, 0]
    for state in (at_contact, below):
        found = next_contact(table, beliefs(model, state))
        assert found.time > 0.3
        assert apex(table, beliefs(model, state)).time == pytest.approx(0.17, abs=0.01)  # 0.9 * 2 m/s, and drag


def test_small_hops_are_all_found(model, beliefs, table):
    belief = beliefs(model, [0, 0, CENTRE + 0.0004, 0, 0, 0, 0, 0, 0])
    count, after = 0, -math.inf
    while (found := next_contact(table, belief, after=after)) is not None:
        count, after = count + 1, found.time
    expected = math.ceil(math.log(0.05 / math.sqrt(2 * 9.81 * 0.0004)) / math.log(0.9))  # rests below 0.05 m/s
    assert count == expected


def test_nothing_happens_to_a_ball_at_rest(model, beliefs, table):
    belief = beliefs(model, [0, 0, CENTRE, 0, 0, 0, 0, 0, 0])
    assert apex(table, belief, 0.5) is None
    assert next_contact(table, belief, 0.5) is None
    assert plane_crossing(table, belief, X, 1.0, 0.5) is None


def test_horizon(model, beliefs, table):
    belief = beliefs(model, RISING, time=3.0)
    at = apex(table, belief).time - 3.0
    assert apex(table, belief, at - 1e-4) is None
    assert apex(table, belief, at + 1e-4).time == pytest.approx(3.0 + at, abs=1e-10)
    contact = next_contact(table, belief).time - 3.0
    assert next_contact(table, belief, contact - 1e-4) is None
    assert next_contact(table, belief, contact + 1e-4).time == pytest.approx(3.0 + contact, abs=1e-10)


def test_table_edge(model, beliefs, table):
    """Past the edge it is the floor; a ball that rolls off meets the floor too; onto the table it is the table."""
    edge = Propagator(EDGE, table.noise)
    past = next_contact(edge, beliefs(model, [0.9, 0, 0.1, 4, 0.3, -1, 10, 30, 5]))
    assert float(past.state[Z]) == pytest.approx(CENTRE - 0.76)
    rolled = next_contact(edge, beliefs(model, [0.95, 0, CENTRE, 2, 0.3, 0, -15, 100, 5]))
    assert float(rolled.state[Z]) == pytest.approx(CENTRE - 0.76)
    onto = next_contact(edge, beliefs(model, [-1.03, 0, 0.1, 4, 0.3, -4, 10, 30, 5]))
    assert float(onto.state[Z]) == pytest.approx(CENTRE)
    assert next_contact(Propagator(Surfaces(-9.0), table.noise), beliefs(model, FALLING), 1.0) is None


def test_rolling_ball_crosses_a_plane(model, beliefs, table):
    """Its height stays fixed at the crossing, whenever that is: its weight does not count."""
    start = [0, 0, CENTRE, 1, 0.3, 0, -15, 50, 5]
    times, states = dense(model, start, table.surfaces, 0.5)
    found = plane_crossing(table, beliefs(model, start), X, 0.2)
    assert found.time == pytest.approx(zero(times, states[:, 0] - 0.2, rising=True), abs=2e-6)
    assert np.abs(found.covariance[VZ]).max() < 1e-12
    assert found.covariance[Z, Z] < 1e-12
    assert 0.002 < found.time_sigma < 0.02


def test_a_jump_through_zero_is_no_crossing(model, beliefs, table):
    def falling(state):
        return -state[..., VZ : VZ + 1]  # jumps from + to - in a bounce, crosses only upwards at the apex

    assert next_crossing(table, beliefs(model, FALLING), falling, 0.3) is None
    again = next_crossing(table, beliefs(model, FALLING), falling, 1.0, either_way=True)
    assert again.time == pytest.approx(apex(table, beliefs(model, FALLING)).time, abs=1e-9)


@pytest.mark.parametrize("start", [FALLING, RISING, [0, 0, CENTRE, 1, 0.3, 0, -15, 50, 5]])
def test_an_event_of_ones_own_is_found_as_a_plane_is(model, beliefs, table, start):
    """The same crossing as any function of the state, which torch follows: flying, after a bounce, rolling."""
    plane = plane_crossing(table, beliefs(model, start), X, 0.2, 1.0)
    own = next_crossing(table, beliefs(model, start), lambda state: 0.2 - state[..., :1], 1.0)
    assert own.time == pytest.approx(plane.time, abs=1e-9)
    assert own.time_sigma == pytest.approx(plane.time_sigma, rel=1e-6)
    np.testing.assert_allclose(own.state, plane.state, rtol=0, atol=1e-7)
    np.testing.assert_allclose(own.covariance, plane.covariance, rtol=1e-6, atol=1e-9)


def test_results_are_plain_arrays(uncertain, beliefs, table):
    """Warnings are errors here: torch's scalars would give one under numpy's functions."""
    belief = beliefs(uncertain, FALLING)
    for found in (
        next_contact(table, belief),
        apex(table, belief),
        plane_crossing(table, belief, [1.0, 0.0, 0.0], 0.3),
    ):
        assert isinstance(found.state, np.ndarray)
        assert np.sqrt(found.covariance[1, 1]) > 0.0
        assert float(found.state[1]) == found.state.tolist()[1]
    predicted = table.rollout(belief, [0.1, 0.2])
    assert np.sqrt(predicted.covariances[0, 1, 0, 0]) > 0.0
    np.testing.assert_array_equal(predicted.times, [[0.1, 0.2]])


def test_wrong_arguments(model, beliefs, table):
    with pytest.raises(ValueError, match="belief must hold one ball; got 2"):
        apex(table, beliefs(model, FALLING, RISING))
    for horizon in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="horizon must be finite and above 0"):
            next_contact(table, beliefs(model, FALLING), horizon)
    for normal in ([0.0, 0.0, 0.0], [1.0, 0.0], [math.nan, 0.0, 1.0]):
        with pytest.raises(ValueError, match="normal must be three finite numbers"):
            plane_crossing(table, beliefs(model, FALLING), torch.tensor(normal), 0.0)
    with pytest.raises(ValueError, match="offset must be finite"):
        plane_crossing(table, beliefs(model, FALLING), X, math.nan)


# --- covariance --------------------------------------------------------------------------------------------------


def compare(found, states, times):
    """Stated against drawn: means to 0.1 sigma, covariances to 0.1 of the product of two sigmas (4000 draws: 0.05)."""
    covariance = torch.from_numpy(found.covariance)
    scale = covariance.diagonal().sqrt()
    known = scale < 1e-9  # what the event itself fixes
    assert (states[:, :STATE_DIM].std(0)[known] < 1e-8).all()
    free = ~known
    drawn = torch.cov(states[:, :STATE_DIM].T)[free][:, free]
    stated, scale = covariance[free][:, free], scale[free]
    assert ((states[:, :STATE_DIM].mean(0) - torch.from_numpy(found.state))[free] / scale).abs().max() < 0.1
    assert ((drawn - stated) / torch.outer(scale, scale)).abs().max() < 0.1
    assert float(times.std()) == pytest.approx(found.time_sigma, rel=0.06)
    assert abs(float(times.mean()) - found.time) < 0.1 * found.time_sigma


def newton(model, state, tau, column, value=0.0):
    """Times (n,) near tau at which a column of the state has a value, in free flight; and the states there."""
    tau = torch.full((len(state),), tau, dtype=torch.float64)
    with torch.no_grad():
        for _ in range(8):
            at = fly(model, state, tau)
            rate = model.rates(at)[0][:, 2] if column == VZ else at[:, 3 + column]
            tau = tau - (at[:, column] - value) / rate
        return tau, fly(model, state, tau)


def test_monte_carlo_of_an_apex(uncertain, beliefs, samples, table):
    belief = beliefs(uncertain, RISING)
    found = apex(table, belief)
    times, states = newton(uncertain, samples(belief, 4000), found.time, VZ)
    compare(found, states, times)


def test_monte_carlo_of_a_contact(uncertain, beliefs, samples, table):
    belief = beliefs(uncertain, FALLING)
    drawn = samples(belief, 4000)
    with torch.no_grad():
        times = contact_time(uncertain, drawn, 0.0)
        states = fly(uncertain, drawn, times)
    found = next_contact(table, belief)
    assert np.sqrt(found.covariance[Z, Z]) == pytest.approx(0.002, rel=1e-6)  # the table's height is uncertain
    compare(found, states, times)


def test_monte_carlo_of_a_plane_after_a_bounce(uncertain, beliefs, samples, table):
    belief = beliefs(uncertain, FALLING)
    found = plane_crossing(table, belief, X, 1.0)
    between = 0.2  # s; the ball bounces at 0.14 s, and is there at 0.27 s
    with torch.no_grad():
        later = advance(uncertain, samples(belief, 4000), torch.full((4000,), between).double(), table.surfaces)
    times, states = newton(uncertain, later, found.time - between, 0, 1.0)
    compare(found, states, times + between)


def test_monte_carlo_of_the_apex_after_a_bounce(uncertain, beliefs, samples, table):
    belief = beliefs(uncertain, FALLING)
    found = apex(table, belief)
    between = 0.25
    with torch.no_grad():
        later = advance(uncertain, samples(belief, 4000), torch.full((4000,), between).double(), table.surfaces)
    times, states = newton(uncertain, later, found.time - between, VZ)
    compare(found, states, times + between)
