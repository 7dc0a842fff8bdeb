"""Predictions of balls that roll over an end of the table, against many balls of another program."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ballfg.dynamics import AnalyticModel, Surfaces, nominal_model, rollout
from ballfg.dynamics.compiled.beliefs.course import Scattered
from ballfg.dynamics.motion.arrays import advance_jacobian
from ballfg.dynamics.motion.limits import OVER_AN_END
from ballfg.dynamics.motion.rollout import _advance
from ballfg.prediction import Belief, Propagator, next_contact, plane_crossing
from tests.prediction.conftest import NEARLY_EXACT

END, G, RADIUS = 1.37, 9.81, 0.02
BALLS, TENTH = 20_000, np.array([0.1])


@pytest.fixture
def ball() -> AnalyticModel:
    """A ball in a vacuum: its motion has a closed form."""
    model = nominal_model("table_tennis").requires_grad_(False)
    model.flight["drag"].k.zero_()
    model.flight["magnus"].k.zero_()
    return model


def rolling(ball: AnalyticModel, way: float, speed: float) -> NDArray[np.float64]:
    """(9,) a ball that rolls along x, so far from the end."""
    height = RADIUS + float(ball.surface_offset(torch.zeros(1, 9, dtype=torch.float64)))
    return np.array([END - way, 0.0, height, speed, 0.0, 0.0, 0.0, speed / RADIUS, 0.0])


def root_of(spread: float) -> NDArray:
    """(9, 2) of the covariance of a rolling ball that is known to 1 mm and a spread (m/s) of its speed."""
    root = np.zeros((9, 2))
    root[[0, 3, 7], [0, 1, 1]] = 0.001, spread, spread / RADIUS
    return root


def belief_of(ball: AnalyticModel, mean: NDArray, root: NDArray) -> Belief:
    covariance = root @ root.T + np.diag(np.full(9, 1e-14))
    return Belief(ball, torch.zeros(1).double(), torch.from_numpy(mean[None]), torch.from_numpy(covariance[None]))


def slowing(ball: AnalyticModel, start: NDArray) -> float:
    """m/s^2, by which a rolling ball (9,) slows down."""
    return -float(ball.roll(torch.from_numpy(start[None]))[0][0, 0])


def falling_balls(start: NDArray, end: NDArray, times: NDArray, slows: float) -> NDArray:
    """(n, k, 4) x, z, vx, vz of balls start (n, 9) with ends (n,) of their own, by the closed form."""
    x, z, v = start[:, :1], start[:, 2:3], start[:, 3:4]
    way = end[:, None] - x
    leave = (v - np.sqrt(np.maximum(v**2 - 2.0 * slows * way, 0.0))) / slows
    leave = np.where(v**2 > 2.0 * slows * way, leave, np.inf)
    rolled, fallen = np.minimum(times, leave), np.maximum(times - leave, 0.0)
    vx = v - slows * rolled
    place = x + v * rolled - slows * rolled**2 / 2.0 + vx * fallen
    return np.stack((place, z - G * fallen**2 / 2.0, vx, -G * fallen), axis=-1)


@pytest.mark.parametrize("sigma", [0.0, 0.01])
@pytest.mark.parametrize(("way", "speed", "spread"), [(0.3, 1.0, 0.02), (0.2, 0.5, 0.01), (0.05, 1.0, 0.003)])
def test_the_fall_is_as_uncertain_as_the_moment_at_which_it_begins(ball, way, speed, spread, sigma):
    mean = rolling(ball, way, speed)
    slows = slowing(ball, mean)
    root = root_of(spread)
    edge = Surfaces(0.0, -5.0, (-np.inf, END, -np.inf, np.inf), (0.0, sigma, 0.0, 0.0))
    late = np.array([-0.02, 0.0, 0.02, 0.05, 0.1, 0.2, 0.3])
    times = (speed - np.sqrt(speed**2 - 2.0 * slows * way)) / slows + late
    belief = belief_of(ball, mean, root)
    predicted = Propagator(edge, NEARLY_EXACT).rollout(belief, times)
    rng = np.random.default_rng(1)
    start = mean + rng.normal(size=(BALLS, 2)) @ root.T
    right = falling_balls(start, END + OVER_AN_END + sigma * rng.normal(size=BALLS), times, slows)
    own = predicted.states[0][:, [0, 2, 3, 5]]
    sigmas = np.sqrt(np.diagonal(predicted.covariances[0], axis1=1, axis2=2))[:, [0, 2, 3, 5]]
    assert np.abs((own - right.mean(axis=0)) / np.maximum(right.std(axis=0), [1e-4, 1e-4, 1e-3, 1e-3])).max() < 0.2
    counts = right.std(axis=0) > [3e-4, 3e-4, 3e-3, 1e-2]  # less is lost in what nothing resolves
    assert sigmas[counts] == pytest.approx(right.std(axis=0)[counts], rel=0.15)
    correlation = predicted.covariances[0, -1, 0, 2] / sigmas[-1, 0] / sigmas[-1, 1]
    assert correlation == pytest.approx(np.corrcoef(right[:, -1, 0], right[:, -1, 1])[0, 1], abs=0.05)


def test_the_fall_begins_at_the_end_however_the_time_is_cut(ball):
    """In torch, in machine code and its derivative, by steps of any length; against the closed form."""
    start, edge = rolling(ball, 0.0437, 1.3), Surfaces(0.0, -5.0, (-np.inf, END, -np.inf, np.inf))
    state, times = torch.from_numpy(start[None]), np.linspace(0.01, 0.3, 30)
    slows = slowing(ball, start)
    right = falling_balls(start[None], np.array([END + OVER_AN_END]), times, slows)[0]
    for cut in (times, times[[4, 29]], times[[29]]):
        moved = rollout(ball, state, torch.from_numpy(cut), edge)[0].numpy()
        assert np.abs(moved[:, [0, 2, 3, 5]] - right[np.isin(times, cut)]).max() < 1e-5
    followed = state.clone().requires_grad_()
    late = _advance(ball, followed, torch.tensor([0.1]).double(), edge)
    slope = torch.autograd.grad(late[0, 2], followed)[0][0].numpy()
    known = advance_jacobian(ball, start, 0.1, edge)
    assert np.abs(known.after - late[0].detach().numpy()).max() < 1e-7
    assert np.abs(known.jacobian[2] - slope).max() < 1e-5
    for change in (np.eye(9)[0], np.eye(9)[3] + np.eye(9)[7] / RADIUS):  # another place; a ball that rolls faster
        ends = falling_balls(start + 1e-5 * np.outer([1, -1], change), np.full(2, END + OVER_AN_END), TENTH, slows)
        assert slope @ change == pytest.approx((ends[0, 0, 1] - ends[1, 0, 1]) / 2e-5, rel=1e-3)


def test_events_below_the_table_are_those_of_the_closed_form(ball):
    start, edge = rolling(ball, 0.3, 1.0), Surfaces(0.0, -0.76, (-np.inf, END, -np.inf, np.inf))
    root = root_of(0.02)
    belief = belief_of(ball, start, root)
    propagator, slows = Propagator(edge, NEARLY_EXACT), slowing(ball, start)
    leave = (1.0 - np.sqrt(1.0 - 2.0 * slows * 0.3001)) / slows
    for found, level in (
        (next_contact(propagator, belief), start[2] - 0.76),
        (plane_crossing(propagator, belief, (0, 0, 1), -0.3), -0.3),
        (plane_crossing(propagator, belief, (0, 0, 1), 0.0169), 0.0169),  # in the step in which it leaves
    ):
        assert found is not None
        assert found.time == pytest.approx(leave + np.sqrt(2.0 * (start[2] - level) / G), abs=3e-5)
    contact = next_contact(propagator, belief)
    assert contact is not None
    x, _, _, v, *_ = (start + np.random.default_rng(2).normal(size=(BALLS, 2)) @ root.T).T
    times = (v - np.sqrt(v**2 - 2.0 * slows * (END + OVER_AN_END - x))) / slows
    assert contact.time_sigma == pytest.approx(times.std(), rel=0.1)


@pytest.mark.parametrize("speed", [0.05, 0.7, 3.0, 12.0])
@pytest.mark.parametrize("turn", [0.0, 0.9, 2.0, 4.0])
def test_a_ball_never_bounces_on_the_end_that_it_rolls_over(speed, turn):
    """Right after it left, the search for its contact comes back to the end itself."""
    model = nominal_model("table_tennis").requires_grad_(False)
    along = np.array([np.cos(turn), np.sin(turn)])
    start = np.array([*-0.02 * speed * along, 0.017, *speed * along, 0.0, *speed / RADIUS * along[::-1], 0.0])
    start[6] *= -1.0
    edge = Surfaces(0.0, -0.76, (-0.001, 0.001, -0.0007, 0.0007))
    start[:2] = 0.0
    moved = rollout(model, torch.from_numpy(start[None]), torch.arange(1, 61).double() * 0.0041, edge)[0].numpy()
    fallen = moved[:, 2] < start[2] - 1e-5
    assert fallen[10:].all()
    assert (np.diff(moved[fallen, 5]) < 0.0).all()


@pytest.mark.thorough
def test_possible_balls_roll_together_as_each_does_alone():
    """Some roll all the time, some over an end, some lie on the floor, others fly or slide."""
    model = nominal_model("table_tennis").requires_grad_(False)
    edge, h, steps = Surfaces(0.0, -0.76, (-0.5, 0.5, -0.3, 0.3)), 0.031, 40
    rng, start = np.random.default_rng(4), np.zeros((60, 9))
    start[:, :2], start[:, 2] = rng.uniform(-0.4, 0.4, (60, 2)) * (1.0, 0.6), 0.017
    start[:, 3:5], start[:, 6:] = rng.normal(0.0, 0.5, (60, 2)), rng.normal(0.0, 30.0, (60, 3))
    start[50:55, 0], start[50:55, 2] = 0.9, 0.017 - 0.76
    start[55:, 2] += 0.2
    chance = np.zeros((steps, 60, 3)), np.zeros((60, 3)), np.zeros((60, 4))
    balls = Scattered.of(model, start, h, chance, edge)
    times = h * torch.arange(1, steps + 1).double()
    alone = np.stack([rollout(model, torch.from_numpy(one[None]), times, edge)[0].numpy() for one in start])
    assert (alone[:50, -1, 2] < 0.0).sum() > 10
    assert np.abs(balls.states[:, 3::3, :3] - alone[..., :3]).max() < 1e-3  # by steps twice as long
    lying = (alone[:50, :, 5] == 0.0).all(axis=1)
    assert lying.sum() > 10
    assert np.abs(balls.states[:50, 3::3] - alone[:50])[lying].max() < 1e-9
