"""A tilted table: the same scene as a level one, turned; its gap and what moves with it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ballfg.dynamics import EFFECTS, AnalyticModel, Coefficient, Flight, FlightEffect, Surfaces
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.effects.bounce import TableTilt
from ballfg.dynamics.model import substitute
from ballfg.dynamics.motion.contact import contact_time, fly_through
from ballfg.dynamics.motion.integrate import batch_jacobian
from ballfg.dynamics.motion.rollout import advance
from tests.dynamics import in_tensors
from tests.dynamics.in_tensors import fly_through_jacobian

TILT = (0.08, -0.05)
TURN = torch.from_numpy(Rotation.from_rotvec([*TILT, 0.0]).as_matrix())
HEIGHT = 0.76
PLACE = torch.tensor((0.0, 0.0, HEIGHT), dtype=torch.float64)


class Push(FlightEffect):
    name = "push"
    sentence = "A constant acceleration in any direction."
    decide = "Nothing."
    coefficients = tuple(Coefficient(axis, 0.0, 1.0, "m/s^2", -20.0, 20.0) for axis in "xyz")

    def acceleration(self, flight: Flight) -> torch.Tensor:
        return torch.stack((self.x, self.y, self.z))


def ball(gravity, **tilt):
    bounce = {"restitution": {}, "friction": {}, "tangential_restitution": {}, "restitution_speed": {"slope": 0.02}}
    effects = [EFFECTS[n](**v) for n, v in {"drag": {}, "magnus": {}, **bounce}.items()]
    push = Push(**dict(zip("xyz", gravity, strict=True)))
    return AnalyticModel([push, *effects, *([TableTilt(**tilt)] if tilt else [])])


LEVEL = ball((0.0, 0.0, -9.81))
TILTED = ball((TURN @ torch.tensor((0.0, 0.0, -9.81), dtype=torch.float64)).tolist(), x=TILT[0], y=TILT[1])


def turned(state):
    """The scene turned about the point of the surface over the origin."""
    parts = state.reshape(-1, 3, 3) @ TURN.T
    parts = parts + torch.stack((PLACE - TURN @ PLACE, 0 * PLACE, 0 * PLACE))
    return parts.reshape(state.shape)


@pytest.fixture
def starts(states):
    start = states(20)
    start[:, 2] += HEIGHT
    return start


def test_gap_is_that_of_the_turned_scene(starts):
    """Over a slope the gap is measured straight down: the distance from the plane, over the normal's z."""
    expected = LEVEL.gap(starts, HEIGHT) / TURN[2, 2]
    torch.testing.assert_close(TILTED.gap(turned(starts), HEIGHT), expected, rtol=0, atol=1e-13)
    torch.testing.assert_close(TILTED.gap_rate(turned(starts)), starts[:, 5] / TURN[2, 2], rtol=0, atol=1e-13)
    fall = LEVEL.rates(starts)[0][:, 2] / TURN[2, 2]
    torch.testing.assert_close(TILTED.gap_acceleration(turned(starts)), fall, rtol=0, atol=1e-12)


def test_a_bounce_is_the_turned_bounce(starts):
    torch.testing.assert_close(
        TILTED.after_bounce(turned(starts)), turned(LEVEL.after_bounce(starts)), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("heights", [(HEIGHT,), (HEIGHT, HEIGHT)])
def test_flight_through_contacts_is_the_turned_flight(starts, heights):
    dt = torch.full((20,), 0.35 * len(heights), dtype=torch.float64)
    starts[:, 2] -= 0.15
    after, times = fly_through(LEVEL, starts, dt, heights)
    seen, seen_times = fly_through(TILTED, turned(starts), dt, heights)
    torch.testing.assert_close(seen_times, times, rtol=0, atol=1e-11)
    torch.testing.assert_close(seen, turned(after), rtol=0, atol=1e-9)
    assert bool(seen.isfinite().all())


def test_so_is_a_rollout(starts):
    """Steps of the integration end at the same times, so that only contacts could differ."""
    dt = torch.full((20,), 0.5, dtype=torch.float64)
    with torch.no_grad():
        after = advance(LEVEL, starts, dt, Surfaces(HEIGHT))
        seen = advance(TILTED, turned(starts), dt, Surfaces(HEIGHT))
    torch.testing.assert_close(seen, turned(after), rtol=0, atol=1e-9)


def test_jacobian_by_two_routes(starts):
    starts[:, 2] -= 0.15
    state, dt = turned(starts), torch.full((20,), 0.35, dtype=torch.float64)
    _, _, jacobian = fly_through_jacobian(TILTED, state, dt, (HEIGHT,))

    def flow(s):
        batch = s.reshape(-1, 9)
        return fly_through(TILTED, batch, dt.repeat(len(batch) // 20), (HEIGHT,))[0].reshape(s.shape)

    _, by_autograd = batch_jacobian(flow, state, outputs=9)
    torch.testing.assert_close(jacobian, by_autograd, rtol=1e-6, atol=1e-6)


def test_contact_time_by_the_tilt_against_differences(starts):
    names = ("bounce.table_tilt.x", "bounce.table_tilt.y")

    def time(x, y):
        return contact_time(substitute(LEVEL_WITH_TILT, dict(zip(names, (x, y), strict=True))), starts, HEIGHT)

    rows = [torch.full((20, 1), value, dtype=torch.float64, requires_grad=True) for value in (0.01, -0.02)]
    slopes = torch.autograd.grad(time(*rows).sum(), rows)
    with torch.no_grad():
        for i, slope in enumerate(slopes):
            up, down = ([r + s * 1e-5 * (j == i) for j, r in enumerate(rows)] for s in (1, -1))
            torch.testing.assert_close(slope[:, 0], (time(*up) - time(*down)) / 2e-5, rtol=1e-6, atol=1e-7)


LEVEL_WITH_TILT = ball((0.0, 0.0, -9.81), x=0.0, y=0.0)


def test_a_tilt_of_zero_is_no_tilt(starts):
    dt = torch.full((20,), 0.4, dtype=torch.float64)
    torch.testing.assert_close(
        in_tensors.fly_through(LEVEL_WITH_TILT, starts, dt, (HEIGHT,)),
        in_tensors.fly_through(LEVEL, starts, dt, (HEIGHT,)),
        rtol=0,
        atol=0,
    )


def test_the_slope_rises_where_the_rotation_says():
    """A turn about x lifts the side of positive y; one about y lowers that of positive x."""
    position = torch.tensor([[2.0, 3.0, 1.0]], dtype=torch.float64)
    assert TableTilt(x=0.1).surface_offset(position).item() == pytest.approx(3 * np.tan(0.1))
    assert TableTilt(y=0.1).surface_offset(position).item() == pytest.approx(-2 * np.tan(0.1))


def test_a_tilt_that_travels_with_the_state(starts):
    names = ("bounce.table_tilt.x", "bounce.table_tilt.y")
    augmented = AugmentedModel(TILTED, names)
    state = augmented.append(turned(starts), torch.tensor(TILT, dtype=torch.float64))
    torch.testing.assert_close(augmented.gap_rate(state), TILTED.gap_rate(turned(starts)), rtol=0, atol=1e-14)
    assert AugmentedModel(LEVEL, ("flight.drag.k",)).surface_slope(state[:, :10]) is None
