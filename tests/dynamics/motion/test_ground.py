"""Rest, rolling and landings in machine code: against the definition in torch, and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces, nominal_model, rollout
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import ROLLING_RESISTANCE, SOFT_SLIP, STANDARD_GRAVITY
from ballfg.dynamics.motion.arrays import advance_jacobian, roll_jacobian
from ballfg.dynamics.motion.integrate import batch_jacobian
from ballfg.dynamics.motion.rollout import advance, roll
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction.belief import Belief
from ballfg.prediction.crossing import plane_crossing
from ballfg.prediction.propagate import Propagator
from ballfg.prediction.state import BallState, World
from tests.dynamics.in_tensors import in_tensors

R = 0.02
EDGED = Surfaces(0.0, -0.5, (-0.3, 0.3, -0.3, 0.3))


def balls(model: AugmentedModel, count: int) -> torch.Tensor:
    """Balls that lie, roll, slide, land and hop low, with the present coefficients."""
    rng, x = np.random.default_rng(11), np.zeros((count, 9))
    x[:, :2] = 0.2 * rng.normal(size=(count, 2))
    x[:, 3:5] = rng.normal(size=(count, 2)) * rng.choice((0, 1, 3), (count, 1))
    x[:, 6:] = rng.normal(size=(count, 3)) * rng.choice((0, 30), (count, 1))
    x[:, 2], x[:, 5] = rng.choice((0.0, 1e-6, 1e-3, 0.03), count), rng.choice((0.0, -0.01, -0.5, 0.3, -3.0), count)
    x[::3, 2], x[::3, 5] = 0.0, 0.0
    x[:, 2] += model.radius + float(torch.as_tensor(model.model.surface_offset(torch.zeros(9))).detach())
    return model.append(torch.from_numpy(x), model.means().detach())


def close(got: torch.Tensor, want: torch.Tensor) -> None:
    torch.testing.assert_close(got, want.detach(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("surfaces", [Surfaces(0.0), EDGED], ids=["endless", "edged"])
@pytest.mark.parametrize("ball", ["table_tennis", "baseball", "football"])
def test_motions_that_end_on_a_surface_are_those_of_torch(ball: str, surfaces: Surfaces) -> None:
    model = AugmentedModel(nominal_model(ball), ("flight.drag.k",))
    for k, start in enumerate(balls(model, 24)[:, None]):
        dt = torch.full((1,), (0.02, 0.005, 0.1)[k % 3], dtype=torch.float64)

        def moved(at: torch.Tensor, dt: torch.Tensor = dt) -> torch.Tensor:
            flat = at.reshape(-1, at.shape[-1])
            return advance(model, flat, dt.expand(len(flat)), surfaces).reshape(at.shape)

        with torch.enable_grad():  # torch's own operations
            after, jacobian = batch_jacobian(moved, start)
        got = advance_jacobian(model, start[0].numpy(), dt.item(), surfaces)
        close(torch.from_numpy(got.after), after[0])
        close(torch.from_numpy(got.jacobian), jacobian[0])
        with torch.no_grad():
            close(rollout(model, start, dt[None], surfaces)[:, 0], after)


def test_rolling_is_that_of_torch(every_effect) -> None:
    model = AugmentedModel(every_effect, ("flight.drag.k", "bounce.table_height.offset"))
    start, dt = balls(model, 12), torch.linspace(0.0, 0.07, 12, dtype=torch.float64)
    for height in (torch.full_like(dt, 0.1), torch.linspace(-0.2, 0.2, 12, dtype=torch.float64)):
        after, jacobian = batch_jacobian(lambda at, height=height: roll(model, at, dt, height), start)
        rolled = in_tensors(roll_jacobian, model, start, dt, height)
        for got, want in zip(rolled, (after, jacobian), strict=True):
            close(got, want)
        with torch.no_grad():
            close(roll(model, start, dt, height), after)


def way(speed: float) -> float:
    """m that a ball rolls from a speed in m/s until it stops: v^2 / (2 a), but for the soft end of the resistance."""
    a, root = ROLLING_RESISTANCE * STANDARD_GRAVITY, np.hypot(speed, SOFT_SLIP)
    return (speed * root + SOFT_SLIP**2 * np.arcsinh(speed / SOFT_SLIP)) / (2 * a)


def test_a_rolling_ball_goes_as_far_as_its_energy_says(build) -> None:
    model, speed = build(gravity={}), 1.0
    start = np.array([0, 0, R, speed, 0, 0, 0, speed / R, 0])
    motion = advance_jacobian(model, start, 20.0, Surfaces(0.0))
    x, v = motion.after[0], motion.after[3]
    assert x == pytest.approx(way(speed) - way(v), abs=1e-9)
    assert way(5.0) == pytest.approx(5.0**2 / (2 * ROLLING_RESISTANCE * STANDARD_GRAVITY), rel=0.01)
    faster = motion.jacobian @ np.array([0, 0, 0, 1, 0, 0, 0, 1 / R, 0])
    first, last = (s / np.hypot(s, SOFT_SLIP) for s in (speed, v))  # deceleration over a
    assert faster[3] == pytest.approx(last / first, rel=1e-8)  # v dv / dx: time is lost at the same rate
    a = ROLLING_RESISTANCE * STANDARD_GRAVITY
    assert faster[0] == pytest.approx((speed - v) / (a * first), rel=1e-8)


def test_a_forecast_rolls_to_its_stop_and_crosses_on_the_way(build) -> None:
    speed = 1.0
    state = np.array([0, 0, R, speed, 0, 0, 0, speed / R, 0])
    spread = np.diag([0.0] * 3 + [0.01, 0.01, 0.0, 0.0, 0.01 / R, 0.0]) ** 2
    spread[3, 7] = spread[7, 3] = 0.01**2 / R
    start = BallState(5.0, state, spread, world=World(build(gravity={}), Surfaces(0.0)))
    ahead = start.predict(60.0, step=0.5)
    assert ahead.positions[-1] == pytest.approx([way(speed), 0.0, R], abs=2e-4)  # it creeps on by 2 exp(-t / 2 s) m/s
    assert ahead.next_contact is None
    assert ahead.apex is None
    there = ahead.crossing(x=2.0)
    assert there is not None
    left = there.state[3]
    assert way(speed) - way(left) == pytest.approx(2.0, abs=1e-9)
    assert ahead.crossing(x=way(speed) + 0.01) is None


def test_at_a_crossing_a_rolling_ball_slows_as_the_ground_makes_it(build) -> None:
    """The covariance on a plane is projected along the motion: a late ball is as slow as its rolling makes it."""
    model = build(gravity={})
    state = np.array([0, 0, R, 1.0, 0, 0, 0, 1.0 / R, 0])
    spread = np.zeros((9, 9))
    spread[0, 0] = 0.01**2
    belief = Belief.of(model, [BallState(0.0, state, spread)])
    still = ProcessNoise(acceleration=1e-9, spin=1e-9)
    found = plane_crossing(Propagator(Surfaces(0.0), still), belief, (1, 0, 0), 0.5)
    assert found is not None
    v = found.state[3]
    slowing = ROLLING_RESISTANCE * STANDARD_GRAVITY * v / np.hypot(v, SOFT_SLIP)
    assert found.time_sigma == pytest.approx(0.01 / v, rel=1e-6)
    assert np.sqrt(found.covariance[3, 3]) == pytest.approx(slowing * 0.01 / v, rel=1e-6)
    assert found.covariance[5, 5] == pytest.approx(0.0, abs=1e-15)
