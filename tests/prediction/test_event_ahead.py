"""Events that were asked for: planes in one direction and after bounces, and how probable they are, by Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.dynamics.motion.rollout import rollout
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import BallState, Plane, next_contact, plane_crossing
from ballfg.prediction.event_ahead import EventAhead, event_numbers, event_on
from ballfg.prediction.forecast import carried_by
from ballfg.prediction.path import PAIRS, Line
from ballfg.prediction.state import World
from ballfg.state import POSITION, VZ
from tests.prediction.conftest import FALLING, NEARLY_EXACT

G = 9.81
MEAN = np.array([0.0, 0.0, 0.3, 3.0, 0.0, 2.5, 0.0, 0.0, 0.0])
SIGMAS = np.array([0.01] * 3 + [0.15] * 3 + [20.0] * 3)
HORIZON, DRAWS, STEPS = 1.0, 4000, 200


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


@pytest.mark.parametrize("late", [-1.0, 0.5, 2.0])
def test_where_all_balls_cross_alike_their_time_alone_is_in_doubt(start, drawn, late):
    """A plane across the way, above the table: no ball has to be drawn, and drawn ones agree."""
    plane = Plane((1.0, 0.0, 0.0), 0.9)
    expected = start.predict(HORIZON).crossing(x=0.9)
    horizon = expected.time + late * expected.time_sigma
    path = start.predict(horizon).path()
    event = event_on(path, plane)
    assert (event.crossing is None) == (late < 0.0)
    assert ("possible" in vars(path)) == (late < 0.0)  # the mean does not get there: balls are counted
    steps = round(horizon / HORIZON * STEPS)
    assert event.probability == pytest.approx(share(0.9 - drawn[: steps + 1, :, 0]), abs=0.05)
    assert event.probability == pytest.approx(path.probability(Line.of(plane)), abs=0.05)


def test_a_plane_that_balls_may_not_reach_has_the_moments_of_those_that_do(start, drawn):
    """A little below the highest point, where some turn before it: the mean's neighbours alone are 0.05 s off."""
    height = start.predict(HORIZON).apex.state[2] - 0.01
    found = start.predict(HORIZON).crossing(z=height, direction="up")
    above = drawn[..., 2] > height
    crossed = ~above[:-1] & above[1:]
    times = np.linspace(0.0, HORIZON, STEPS + 1)[1:][crossed.argmax(axis=0)][crossed.any(axis=0)]
    spread = np.sqrt(((times - found.time) ** 2).mean())
    assert found.time_sigma == pytest.approx(spread, rel=0.1)


def test_a_plane_that_is_never_met_in_that_direction_has_no_chance(start):
    ahead = start.predict(HORIZON, 0.005)
    assert ahead.event("x=1.5,down") == EventAhead(None, 0.0) or ahead.event("x=1.5,down").probability == 0.0
    assert ahead.event("x=1.5,up").probability > 0.999
    assert ahead.event("z=0.3,down,after=20").probability == 0.0


def test_a_ball_at_rest_meets_nothing(world):
    lying = BallState(0.0, np.array([0.0, 0.0, 0.017, *[0.0] * 6]), np.diag([1e-8] * 9), (), world)
    assert lying.predict(0.5).event("next-contact").probability == 0.0


SCENES = {
    "falling": (FALLING, 0.1, Surfaces(0.0), 1.0, (
        "z=0.01,down", "z=0.021,down", "z=0.05,down", "z=0.1,down", "z=0.15,up", "z=0.22,up", "z=0.25,up", "z=0.22",
        "z=0.22,down,after=1", "z=0.05,down,after=1", "z=0.05,down,after=2", "z=0.1,up,after=2", "z=0.302,down",
        "x=2.0", "x=2.7",
    )),
    "rising": (MEAN, 0.3, Surfaces(0.0), 0.62, (
        "z=0.05,down", "z=0.1,down", "z=0.58,down", "z=0.7,up", "z=0.05,up,after=1", "x=1.6", "x=1.7",
    )),
    "at the end of a table": (FALLING, 0.2, Surfaces(0.0, -0.76, (-2.0, 0.6, -0.7, 0.7)), 0.4, (
        "z=-0.3,down", "z=-0.02,down", "z=0.1,up", "z=0.05,down",
    )),
    "over the end of a table": (FALLING, 0.2, Surfaces(0.0, -0.76, (-2.0, 0.68, -0.7, 0.7)), 1.0, (
        "z=-0.3,down", "z=-0.3,down,after=1", "z=0.03,down",
    )),
}  # fmt: skip
"""By name: mean, sigma of the velocity in m/s, surfaces, horizon in s, planes."""


@pytest.fixture(scope="module", params=list(SCENES))
def scene(request, world):
    """The ball of a scene, its planes, and (balls, times, 9) rollouts of balls of the same distribution."""
    mean, vague, surfaces, horizon, planes = SCENES[request.param]
    sigmas = np.array([0.01] * 3 + [vague] * 3 + [20.0] * 3)
    ball = BallState(0.0, mean, np.diag(sigmas**2), (), World(world.model, surfaces, NEARLY_EXACT))
    first = torch.from_numpy(mean + sigmas * np.random.default_rng(3).standard_normal((DRAWS // 2, 9)))
    times = torch.linspace(0.0025, horizon, round(horizon / 0.0025), dtype=torch.float64)
    later = rollout(world.model, first, times, surfaces).numpy()
    return ball, horizon, planes, np.concatenate((first.numpy()[:, None], later), axis=1)


def share_through(states, plane):
    """Share of balls (balls, times, 9) that go through a plane in its direction after its bounces."""
    (normal, offset), speeds = plane.line, states[..., VZ]
    bounced = np.cumsum((speeds[:, :-1] < 0.0) & (np.diff(speeds) > 0.1), axis=1)
    counts = np.pad(bounced, ((0, 0), (1, 0))) >= plane.after
    above, below = ((side * (states[..., POSITION] @ normal - offset) > 0.0) & counts for side in (1.0, -1.0))
    ways = [(first & ~second, second) for first, second in ((above, below), (below, above))]
    fell, rose = ((np.maximum.accumulate(first, axis=1) & second).any(axis=1) for first, second in ways)
    return {"down": fell, "up": rose, "either": fell | rose}[plane.direction].mean()


def test_probabilities_are_the_shares_of_balls_of_the_belief(scene):
    """Within the band of 99.9 % for as many balls as are moved, and without doubt where all or none have the event."""
    ball, horizon, planes, states = scene
    ahead, count = ball.predict(horizon), 2 * PAIRS
    for text in planes:
        told, share = ahead.event(text).probability, share_through(states, Plane.parse(text))
        low, high = stats.binom.interval(0.999, count, share) if 0.0 < share < 1.0 else (count * share, count * share)
        assert low <= count * told <= high, (text, told, share)


@pytest.mark.parametrize("floor", [-0.76, None])
@pytest.mark.parametrize("end", [0.55, 0.6, 0.66])
@pytest.mark.parametrize("horizon", [0.2, 0.25, 0.8])
def test_a_contact_near_the_end_of_a_table_is_that_of_balls_on_both_sides(world, floor, end, horizon):
    """Some balls come down on the table, the others fall past it to the floor, if there is one."""
    sigmas, surfaces = np.array([0.01] * 3 + [0.2] * 3 + [20.0] * 3), Surfaces(0.0, floor, (-2.0, end, -0.7, 0.7))
    ball = BallState(3.0, FALLING, np.diag(sigmas**2), (), World(world.model, surfaces, NEARLY_EXACT))
    first = torch.from_numpy(FALLING + sigmas * np.random.default_rng(3).standard_normal((DRAWS // 4, 9)))
    times = torch.linspace(0.0025, horizon, round(horizon / 0.0025), dtype=torch.float64)
    later = rollout(world.model, first, times, surfaces).numpy()
    rises = np.diff(later[..., VZ], axis=1) > 0.1
    rows, at = np.flatnonzero(rises.any(axis=1)), rises.argmax(axis=1)
    told = ball.predict(horizon).event("next-contact")
    low, high = stats.binom.interval(0.999, 2 * PAIRS, len(rows) / len(first))
    assert low <= 2 * PAIRS * told.probability <= high
    if horizon == 0.8 and told.crossing is not None:
        there, when = later[rows, at[rows]], times.numpy()[at[rows]] + 3.0
        about = np.sqrt(np.square(there - told.crossing.state).mean(axis=0))[[0, 2, 5]]
        own = np.sqrt(np.diagonal(told.crossing.covariance))[[0, 2, 5]]
        assert own == pytest.approx(about, rel=0.25, abs=6e-3)  # rollouts by 2.5 ms, at 2.4 m/s
        assert told.crossing.time_sigma == pytest.approx(np.sqrt(np.square(when - told.crossing.time).mean()), rel=0.25)


@pytest.mark.parametrize("far", [1.0, 60.0])
def test_an_apex_high_above_the_way_to_a_table_end_is_that_of_the_noise(far):
    """In vacuum, in closed form: white acceleration alone makes the apex uncertain; the end that comes later does not.

    Args: far: m to the end of the table. The ball comes down beyond it, or on the table.
    """
    model, noise, rise = nominal_model(), ProcessNoise(acceleration=0.5), 0.25
    with torch.no_grad():
        for name in ("drag", "magnus"):
            model.get_parameter(f"flight.{name}.k").zero_()
    start = np.array([0.0, 0.0, 0.6, 6.0, 0.0, rise, 0.0, 0.0, 0.0])
    surfaces = Surfaces(0.0, -0.76, (-2.0, far, -3.0, 3.0))
    ball = BallState(0.0, start, np.diag([1e-6] * 6 + [1e-3] * 3) ** 2, (), World(model, surfaces, noise))
    assert ball.predict(0.8).apex.time_sigma == pytest.approx(0.5 * np.sqrt(rise / G) / G, rel=0.01)


@pytest.mark.parametrize("text", ["z=0.1,up", "z=0.1,down,after=1", "x=1.0,after=1", "z=-0.1,down", "x=1.0"])
@pytest.mark.parametrize("end", [0.6, 0.64, 0.7])
def test_a_crossing_by_the_end_of_a_table_is_that_of_the_balls_that_have_one(world, text, end):
    """Balls that fall past the end do not widen what those that bounce do, and the other way round."""
    sigmas, surfaces = np.array([0.005] * 3 + [0.2] * 3 + [5.0] * 3), Surfaces(0.0, -0.76, (-2.0, end, -0.7, 0.7))
    ball = BallState(3.0, FALLING, np.diag(sigmas**2), (), World(world.model, surfaces, NEARLY_EXACT))
    first = torch.from_numpy(FALLING + sigmas * np.random.default_rng(3).standard_normal((DRAWS // 4, 9)))
    times = torch.linspace(0.001, 0.7, 700, dtype=torch.float64)
    later, plane = rollout(world.model, first, times, surfaces).numpy(), Plane.parse(text)
    found = ball.predict(0.7).event(plane).crossing
    if found is None:
        assert plane.after or plane.direction == ("down" if end == 0.7 else "up")
        return
    (normal, offset), bounced = plane.line, np.cumsum(np.diff(later[..., VZ], axis=1, prepend=-9.0) > 0.1, axis=1) > 1
    above = later[..., POSITION] @ normal > offset
    crosses = (above[:, 1:] != above[:, :-1]) & (bounced[:, :-1] | (plane.after == 0))
    if plane.direction != "either":
        crosses &= above[:, 1:] == (plane.direction == "up")
    rows = np.flatnonzero(crosses.any(axis=1))
    at = crosses[rows].argmax(axis=1)
    about = np.sqrt(np.square(later[rows, at] - found.state).mean(axis=0))[3:6]
    assert np.sqrt(np.diagonal(found.covariance))[3:6] == pytest.approx(about, rel=0.25, abs=0.02)
    assert found.time_sigma == pytest.approx(np.sqrt(np.square(times.numpy()[at] + 3.0 - found.time).mean()), rel=0.2)


@pytest.mark.parametrize(
    "rising", [0.35, -0.05, *(pytest.param(v, marks=pytest.mark.thorough) for v in (0.2, 0.05, -0.2))]
)
@pytest.mark.parametrize("text", ["apex", "z=0.15", "z=0.15,down"])
def test_an_event_that_may_just_have_been_is_in_doubt(world, text, rising):
    """Some balls are at their highest point now, the others after the next bounce; some are above the plane."""
    mean, sigmas = (
        np.array([0.0, 0.0, 0.15, 3.0, 0.0, rising, 0.0, 0.0, 0.0]),
        np.array([0.002] * 3 + [0.2] * 3 + [5.0] * 3),
    )
    ball = BallState(3.0, mean, np.diag(sigmas**2), (), World(world.model, Surfaces(0.0), NEARLY_EXACT))
    first = torch.from_numpy(mean + sigmas * np.random.default_rng(3).standard_normal((DRAWS // 4, 9)))
    times = torch.linspace(0.001, 0.7, 700, dtype=torch.float64)
    later = np.concatenate((first.numpy()[:, None], rollout(world.model, first, times, Surfaces(0.0)).numpy()), axis=1)
    value = later[..., VZ] if text == "apex" else later[..., 2] - 0.15
    passes = (value[:, :-1] > 0.0) & (value[:, 1:] <= 0.0)
    if text == "z=0.15":
        passes |= (value[:, :-1] < 0.0) & (value[:, 1:] >= 0.0)
    rows = np.flatnonzero(passes.any(axis=1))
    at = passes[rows].argmax(axis=1)
    told = ball.predict(0.7).event(text)
    assert told.probability == pytest.approx(len(rows) / len(first), abs=0.06)
    if told.crossing is None:
        assert text != "apex"
        assert rising < 0.0
        return
    assert told.crossing.time_sigma == pytest.approx(
        np.sqrt(np.square(0.001 * at + 3.0 - told.crossing.time).mean()), rel=0.2
    )
    about = np.sqrt(np.square(later[rows, at] - told.crossing.state).mean(axis=0))[[0, 2, 3, 5]]
    assert np.sqrt(np.diagonal(told.crossing.covariance))[[0, 2, 3, 5]] == pytest.approx(about, rel=0.2, abs=6e-3)


VAGUE = np.array([0.01, 0.01, 0.02, 0.1, 0.1, 0.1, 20.0, 20.0, 20.0])


@pytest.fixture(scope="module")
def fallen(world):
    """Times (k,) s and (balls, k, 9) rollouts of falling balls that are known to `VAGUE`."""
    first = torch.from_numpy(FALLING + VAGUE * np.random.default_rng(3).standard_normal((DRAWS // 5, 9)))
    times = torch.linspace(0.0005, 0.8, 1600, dtype=torch.float64)
    return times.numpy(), rollout(world.model, first, times, Surfaces(0.0)).numpy()


@pytest.mark.parametrize("plane", ["x=0.5", "x=0.57,up", "x=0.62,up", "x=0.7,up", "z=0.03,up,after=1", "x=1.2"])
def test_a_crossing_near_a_bounce_holds_the_balls_on_both_sides(world, fallen, plane):
    """Spreads about the mean ball's crossing against those of rollouts of many balls; far from a bounce too."""
    ball = BallState(3.0, FALLING, np.diag(VAGUE**2), (), World(world.model, Surfaces(0.0), NEARLY_EXACT))
    asked, (times, later) = Plane.parse(plane), fallen
    found = ball.predict(0.8).event(asked).crossing
    (normal, offset), bounced = asked.line, np.maximum.accumulate(later[..., VZ] > 0.0, axis=1)
    crosses = (later[..., POSITION] @ normal > offset) & (bounced | (asked.after == 0))
    at = crosses.argmax(axis=1)
    some = crosses.any(axis=1) & (at > 0)
    there, when = later[some, at[some]], times[at[some]] + 3.0
    shares = bounced[some, at[some]].mean()
    assert (0.1 < shares < 0.9) == (plane in ("x=0.57,up", "x=0.62,up"))
    own = np.sqrt(np.diagonal(found.covariance))
    about = np.sqrt(np.square(there - found.state).mean(axis=0))
    assert own[[1, 3, 4, 5]] == pytest.approx(about[[1, 3, 4, 5]], rel=0.15)
    assert own[[0, 2]] == pytest.approx(about[[0, 2]], rel=0.2, abs=1.5e-3)  # rollouts by half a millisecond
    assert found.time_sigma == pytest.approx(np.sqrt(np.square(when - found.time).mean()), rel=0.15)


def test_a_ball_that_rolls_falls_off_the_end(world):
    """It neither hops nor has an apex; every ball gets to the end within the horizon, or none does."""
    height = 0.02 + float(world.model.surface_offset(torch.zeros(1, 9, dtype=torch.float64)))
    mean = np.array([0.0, 0.0, height, 0.8, *[0.0] * 5])
    surfaces = Surfaces(0.0, -0.76, (-2.0, 0.2, -0.7, 0.7))
    rolling = BallState(0.0, mean, np.diag([1e-8] * 9), (), World(world.model, surfaces))
    ahead = rolling.predict(1.0)
    assert ahead.event("z=-0.3,down").probability == 1.0
    assert ahead.event("apex").probability == 0.0
    long_table = replace(rolling, world=World(world.model, Surfaces(0.0, -0.76, (-2.0, 5.0, -0.7, 0.7))))
    assert long_table.predict(1.0).event("z=-0.3,down").probability == 0.0


@pytest.mark.parametrize("bounced", [False, True])
def test_the_next_contact_is_in_doubt_with_the_present_one(world, bounced):
    """The ball is about to bounce, or has just done so; with a chance of 0.2 it is the other way round."""
    share, falling = 0.2, torch.tensor([[0.0, 0.0, 0.0205, 3.0, 0.0, -3.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    risen = world.model.after_bounce(falling)
    own, other = (risen, falling) if bounced else (falling, risen)
    jump = np.zeros(9)
    jump[VZ] = float((other - own)[0, VZ])
    sure = BallState(5.0, own[0].numpy(), 1e-6 * np.eye(9), (), world)
    doubt = share * np.outer(jump, jump)
    plain, torn = sure.predict(1.0), replace(sure, joint=sure.joint + doubt, other_side=doubt).predict(1.0)
    told, first = torn.event("next-contact"), plain.next_contact
    if bounced:
        apart, away = first.time - 5.0, first.state[0]
    else:
        second = next_contact(*carried_by(sure), 1.0, after=first.time)
        apart, away = second.time - first.time, second.state[0] - first.state[0]
    assert told.crossing.time == torn.next_contact.time == first.time
    assert told.crossing.time_sigma == pytest.approx(np.sqrt(share) * apart, rel=0.02)
    assert np.sqrt(told.crossing.covariance[0, 0]) == pytest.approx(np.sqrt(share) * away, rel=0.02)
    assert first.time_sigma < 0.01
    soon = replace(torn, horizon=0.1)
    assert soon.event("next-contact").probability == pytest.approx(share if bounced else 1.0 - share, abs=0.01)
    assert (soon.next_contact is None) == bounced


@pytest.mark.parametrize("bounced", [False, True])
def test_bounces_before_a_crossing_are_in_doubt_with_the_present_one(world, bounced):
    """A ball that has just bounced needs another bounce; with a chance of 0.2 it is the other way round."""
    share, falling = 0.2, torch.tensor([[0.0, 0.0, 0.0205, 3.0, 0.0, -3.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    risen = world.model.after_bounce(falling)
    own, other = (risen, falling) if bounced else (falling, risen)
    jump = np.zeros(9)
    jump[VZ] = float((other - own)[0, VZ])
    doubt = share * np.outer(jump, jump)
    torn = BallState(5.0, own[0].numpy(), 1e-6 * np.eye(9) + doubt, (), world, other_side=doubt)
    rises, again = torn.predict(0.2).event("z=0.1,up,after=1"), torn.predict(0.9).event("z=0.1,up,after=2")
    assert rises.probability == pytest.approx(share if bounced else 1.0 - share, abs=0.01)
    assert again.probability == pytest.approx(share if bounced else 1.0 - share, abs=0.01)
    assert torn.predict(0.2).event("z=0.1,up").probability == 1.0


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
