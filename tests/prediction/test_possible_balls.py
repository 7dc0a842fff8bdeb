"""Possible balls move as other balls do, with the noise of the motion; their shares are probabilities of events."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces
from ballfg.dynamics.compiled.beliefs.course import Scattered
from ballfg.dynamics.motion.rollout import rollout
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import BallState
from ballfg.prediction.belief import normal_points
from ballfg.prediction.forecast import carried_by
from ballfg.prediction.path import PAIRS, Path
from ballfg.prediction.state import World
from ballfg.state import VZ
from tests.prediction.conftest import FALLING


def test_points_stand_for_a_normal():
    points = normal_points(PAIRS, 20)
    assert points.mean(axis=0) == pytest.approx(0.0, abs=1e-9)
    assert points.T @ points / len(points) == pytest.approx(np.eye(20), abs=1e-9)
    for way in (np.eye(20)[3], np.array([0.6, 0.0, -0.8, *[0.0] * 17])):
        for quantile in (-1.5, -0.5, 0.5, 1.5):
            assert (points @ way < quantile).mean() == pytest.approx(stats.norm.cdf(quantile), abs=0.06)


@pytest.mark.parametrize("tilt", [0.01, 0.1, -0.2])
def test_possible_balls_bounce_on_a_table_that_leans(tilt):
    """Where every other ball meets it: over a step of 0.08 s it rises or falls by centimetres under a ball."""
    effects = ("gravity", "drag", "magnus", "restitution", "friction")
    model = AnalyticModel([*(EFFECTS[name]() for name in effects), EFFECTS["table_tilt"](y=tilt)])
    start = FALLING + np.array([0.02] * 3 + [0.5] * 3 + [50.0] * 3) * np.random.default_rng(9).standard_normal((100, 9))
    start[:, 2] += 0.2
    calm = np.zeros((6, 100, 3)), np.zeros((100, 3)), np.zeros((100, 4))
    balls = Scattered.of(model.requires_grad_(False), start, 0.08, calm, Surfaces(0.0))
    times = 0.08 * torch.arange(1, 7, dtype=torch.float64)
    exact = rollout(model, torch.from_numpy(start), times, Surfaces(0.0)).numpy()
    assert balls.met[:, -1].min() > 0
    assert np.abs(balls.states[:, 3::3] - exact)[..., :3].max() < 1e-4


@pytest.mark.parametrize("surfaces", [Surfaces(0.0), Surfaces(0.0, -0.76, (-2.0, 0.6, -0.7, 0.7))])
def test_possible_balls_move_as_every_other_ball_does(world, surfaces):
    """Fast ones, ones that come to rest in low hops, and ones that fall past the table's end, each without chance."""
    rng, step, steps = np.random.default_rng(9), 0.08, 12
    start = FALLING + np.array([0.1] * 3 + [2.0] * 3 + [100.0] * 3) * rng.standard_normal((400, 9))
    start[::4, 2:6] *= [0.1, 0.1, 0.1, 0.0]
    start[:, 2] = np.abs(start[:, 2]) + 0.03
    calm = np.zeros((steps, 400, 3)), np.zeros((400, 3)), np.zeros((400, 4))
    balls = Scattered.of(world.model, start, step, calm, surfaces)
    times = step * torch.arange(1, steps + 1, dtype=torch.float64)
    exact = rollout(world.model, torch.from_numpy(start), times, surfaces).numpy()
    assert balls.times[:, 3::3] == pytest.approx(np.tile(times, (400, 1)))
    off = np.abs(balls.states[:, 3::3] - exact)
    assert off[..., :3].max() < 1e-3
    assert np.quantile(off[..., 3:6].max(axis=(1, 2)), 0.98) < 0.02  # the others bounce right at the end of a step
    before, left, bounced = balls.states[:, 1::3], balls.states[:, 2::3], np.diff(balls.met[:, ::3], axis=1) == 1
    assert bounced.sum() > 300
    bounced &= left[..., VZ] > 0.0  # else at rest by the end of the step
    impact = world.model.after_bounce(torch.from_numpy(before[bounced])).numpy()
    assert left[bounced] == pytest.approx(impact, abs=2e-3)
    if surfaces.floor_height is None:
        assert balls.states[..., 2].min() > 0.01  # no moment lies below the table


@pytest.mark.parametrize("mean", [[0.0, 0.0, 9.0, 3.0, 0.5, 1.0, 0.0, 0.0, 0.0], FALLING])
def test_possible_balls_have_the_noise_of_the_motion(world, mean):
    """In flight, and after a bounce: an exactly known ball is as uncertain as its prediction later."""
    noise = ProcessNoise(acceleration=0.1, contact_velocity=0.05, contact_tangential=0.1)
    ball = BallState(0.0, np.array(mean), 1e-16 * np.eye(9), (), World(world.model, Surfaces(0.0), noise))
    balls = Path(ball, carried_by(ball), 0.48).possible
    there = ball.predict(0.48, 0.48)
    spread = balls.states[:, -1, :6].std(axis=0)
    assert spread[:3] == pytest.approx(there.sigmas[-1], rel=0.1)
    assert spread[3:] == pytest.approx(np.sqrt(np.diagonal(there.covariances[-1]))[3:6], rel=0.15)
    assert np.unique(balls.met[:, -1]).tolist() == [float(mean is FALLING)]


def test_possible_balls_have_the_noise_of_the_motion_from_the_first_steps_on(world):
    """However far the horizon: white acceleration gives a variance that grows with time, a lasting one with its square.

    A position is off by an eighth at the end of the first step, which has one push.
    """
    ball = BallState(
        0.0,
        np.array([0.0, 0.0, 50.0, 3.0, 0.5, 1.0, 0.0, 0.0, 0.0]),
        1e-16 * np.eye(9),
        (),
        World(world.model, Surfaces(0.0), ProcessNoise(acceleration=0.1)),
    )
    balls = Path(ball, carried_by(ball), 3.0).possible
    for moment in (3, 6, 15, 30):
        t = float(balls.times[0, moment])
        there = np.sqrt(np.diagonal(ball.predict(t, t).covariances[-1]))[:6]
        assert balls.states[:, moment, :6].std(axis=0) == pytest.approx(there, rel=0.2)
