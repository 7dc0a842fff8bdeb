"""Events that were asked for: planes in one direction and after bounces, and how probable they are, by Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.dynamics.motion.rollout import rollout
from ballfg.prediction import BallState, Plane, plane_crossing
from ballfg.prediction.event_ahead import EventAhead, event_numbers, falls
from ballfg.prediction.state import World
from ballfg.state import POSITION, VZ

G = 9.81
MEAN = np.array([0.0, 0.0, 0.3, 3.0, 0.0, 2.5, 0.0, 0.0, 0.0])
SIGMAS = np.array([0.01] * 3 + [0.15] * 3 + [20.0] * 3)
HORIZON, DRAWS, STEPS = 1.0, 4000, 200


@pytest.fixture(scope="module")
def world():
    return World(nominal_model("table_tennis").requires_grad_(False), Surfaces(0.0))


@pytest.fixture(scope="module")
def start(world):
    """A ball that rises and falls onto a table, with a doubt of 0.15 m/s."""
    return BallState(0.0, MEAN, np.diag(SIGMAS**2), (), world)


@pytest.fixture(scope="module")
def drawn(world):
    """(times, balls, 9) rollouts of balls of the same distribution."""
    first = torch.from_numpy(MEAN + SIGMAS * np.random.default_rng(3).standard_normal((DRAWS, 9)))
    times = torch.linspace(HORIZON / STEPS, HORIZON, STEPS, dtype=torch.float64)
    later = rollout(world.model, first, times, world.surfaces)
    return torch.cat((first[:, None], later), dim=1).transpose(0, 1).numpy()


def share(value):
    """Share of balls (times, balls) whose value is positive and later negative."""
    above = np.maximum.accumulate(value > 0.0, axis=0)
    return (above[:-1] & (value[1:] < 0.0)).any(axis=0).mean()


@pytest.mark.parametrize(
    ("text", "plane"),
    [
        ("x=2.0", Plane((1.0, 0.0, 0.0), 2.0)),
        (" y = -0.5 ", Plane((0.0, 1.0, 0.0), -0.5)),
        ("z=3.05,down", Plane((0.0, 0.0, 1.0), 3.05, "down")),
        ("z=0.9, up, after=2", Plane((0.0, 0.0, 1.0), 0.9, "up", 2)),
        ("z=0.9,after=1", Plane((0.0, 0.0, 1.0), 0.9, "either", 1)),
        ("0.6:0:0.8=1.2", Plane((0.6, 0.0, 0.8), 1.2)),
    ],
)
def test_planes_are_read(text, plane):
    assert Plane.parse(text) == plane


@pytest.mark.parametrize(
    "text", ["x", "w=1", "x=one", "x=nan", "x=1=2", "z=1,sideways", "z=1,up,down", "z=1,after=", "1:0=2", "0:0:inf=1"]
)
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError, match=r"plane must be an axis and a place in m; got .* Write x=2\.0"):
        Plane.parse(text)


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        (((0.0, 0.0, 0.0), 1.0), "normal must be"),
        (((1.0, 0.0, 0.0), np.inf), "offset must be"),
        (((1.0, 0.0, 0.0), 1.0, "left"), "direction must be .*got 'left'"),
        (((1.0, 0.0, 0.0), 1.0, "up", 21), r"after must lie in 0 \.\. 20; got 21"),
    ],
)
def test_planes_that_are_none_are_refused(given, rule):
    with pytest.raises(ValueError, match=rule):
        Plane(*given)


def test_directions_are_the_two_roots_of_a_throw(gravity, beliefs, table):
    ball = beliefs(gravity, [0.0, 0.0, 0.3, 1.0, 0.0, 4.0, 0.0, 0.0, 0.0])
    up, down = ((4.0 + side * np.sqrt(16.0 - 2.0 * G * 0.5)) / G for side in (-1.0, 1.0))
    for direction, time in (("up", up), ("down", down), ("either", up)):
        found = plane_crossing(table, ball, [0.0, 0.0, 2.0], 1.6, direction=direction)  # z = 0.8
        assert found.time == pytest.approx(time, abs=1e-9)
        assert np.sign(found.state[VZ]) == (1.0 if time == up else -1.0)
    backwards = plane_crossing(table, ball, [0.0, 0.0, -1.0], -0.8, direction="up")
    assert backwards.time == pytest.approx(down, abs=1e-9)


def test_a_crossing_after_bounces_is_the_first_after_them(start):
    ahead = start.predict(2.0)
    first = ahead.next_contact
    later = ahead.crossing(z=0.2, direction="up", after=1)
    again = ahead.crossing(z=0.2, direction="up", after=2)
    assert ahead.crossing(z=0.2, direction="up") is not None
    assert first.time < later.time < ahead.crossing(z=0.2, direction="down", after=1).time < again.time
    assert later.state[VZ] > 0.0
    assert ahead.crossing(z=0.2, direction="up", after=20) is None


def test_the_event_is_the_crossing_of_the_forecast(start):
    ahead = start.predict(HORIZON, 0.005)
    assert ahead.event("apex").crossing.time == ahead.apex.time
    assert ahead.event("next-contact").crossing.time == ahead.next_contact.time
    assert ahead.event("x=1.5,up").crossing.time == ahead.crossing(x=1.5).time
    with pytest.raises(ValueError, match=r"event must be apex, next-contact or a plane .* got 'top'"):
        ahead.event("top")


@pytest.mark.parametrize("height", [0.5, 0.55, 0.58, 0.6, 0.62, 0.65])
def test_the_probability_to_pass_a_height_is_the_share_of_balls_that_do(start, drawn, height):
    ahead = start.predict(HORIZON, 0.005)
    down, up = ahead.event(f"z={height},down"), ahead.event(f"z={height},up")
    assert down.probability == pytest.approx(share(drawn[..., 2] - height), abs=0.025)
    assert up.probability == pytest.approx(share(height - drawn[..., 2]), abs=0.025)
    assert (down.crossing is None) == (down.probability < 0.5)


@pytest.mark.parametrize("height", [0.35, 0.4, 0.45])
def test_after_a_bounce_the_probability_counts_later_balls_alone(start, drawn, height):
    bounced = np.maximum.accumulate(np.diff(np.sign(drawn[..., VZ]), axis=0) > 0, axis=0)
    rose = (bounced & (drawn[1:, :, 2] > height)).any(axis=0).mean()
    found = start.predict(HORIZON, 0.005).event(f"z={height},up,after=1")
    assert found.probability == pytest.approx(rose, abs=0.06)


@pytest.mark.parametrize("horizon", [0.5, 0.58, 0.6, 0.62, 0.7])
def test_the_probability_of_a_contact_is_that_of_its_time(start, drawn, horizon):
    steps = round(horizon / HORIZON * STEPS)
    bounced = (np.diff(np.sign(drawn[: steps + 1, :, VZ]), axis=0) > 0).any(axis=0).mean()
    assert start.predict(horizon, 0.005).event("next-contact").probability == pytest.approx(bounced, abs=0.06)


def test_a_plane_that_is_never_met_in_that_direction_has_no_chance(start):
    ahead = start.predict(HORIZON, 0.005)
    assert ahead.event("x=1.5,down") == EventAhead(None, 0.0) or ahead.event("x=1.5,down").probability == 0.0
    assert ahead.event("x=1.5,up").probability > 0.999
    assert ahead.event("z=0.3,down,after=20").probability == 0.0


def test_a_ball_at_rest_meets_nothing(world):
    lying = BallState(0.0, np.array([0.0, 0.0, 0.017, *[0.0] * 6]), np.diag([1e-8] * 9), (), world)
    assert lying.predict(0.5).event("next-contact").probability == 0.0


def test_errors_that_last_fall_through_zero_in_the_quantiles_between():
    value, sigma = np.array([-1.0, 1.0, -0.5]), np.ones(3)
    assert falls(value, sigma) == pytest.approx(0.841345 - 0.308538, abs=1e-6)  # Phi(1) - Phi(-0.5)
    assert falls(-value[::-1], sigma) == pytest.approx(0.841345 - 0.158655, abs=0.2)
    assert falls(np.linspace(-2.0, 2.0, 9), np.ones(9)) == 0.0
    two_humps = np.array([1.0, -1.0, 2.0, -2.0])
    assert falls(two_humps, np.ones(4)) == pytest.approx(0.977250 - 0.022750, abs=1e-6)


def test_numbers_of_an_event_are_those_of_its_state(start):
    found = start.predict(HORIZON).next_contact
    numbers = event_numbers(found)
    assert [numbers[axis] for axis in "xyz"] == found.state[POSITION].tolist()
    assert numbers["speed"] == pytest.approx(np.linalg.norm(found.state[3:6]))
    assert numbers["cov_xy"] == found.covariance[0, 1]
    along = found.state[3:6] / numbers["speed"]
    assert numbers["sigma_speed"] == pytest.approx(np.sqrt(along @ found.covariance[3:6, 3:6] @ along))
    assert set(event_numbers(None)) == set(numbers)
    assert np.isnan(list(event_numbers(None).values())).all()
