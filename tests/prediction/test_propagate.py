"""Mean and covariance of a rollout: closed forms, central differences, Monte Carlo."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces
from ballfg.dynamics.motion.rollout import advance, rollout
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import Belief, Propagator
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY, VZ, Z

FALLING = [0.0, 0.0, 0.25, 4.0, 0.3, -1.0, 10.0, 30.0, 5.0]
RISING = [0.0, 0.0, 0.25, 4.0, 0.3, 2.0, 10.0, 30.0, 5.0]
FAR = Surfaces(table_height=-100.0)
EDGE = Surfaces(0.0, -0.76, extent=(-1.0, 1.0, -0.7, 0.7))
CENTRE = 0.016  # m, z of a ball that lies on the table of the fixture `model`: radius 0.02, offset -0.004

# state, surfaces, time, impacts on the way
PATHS = {
    "flight": (RISING, FAR, 0.3, 0),
    "bounce": (FALLING, None, 0.3, 1),
    "bounce within one step": ([0, 0, 0.03, 4, 0.3, -1.5, 10, 30, 5], None, 0.015, 1),
    "three bounces": ([0, 0, 0.1, 1, 0.3, -1, 10, 30, 5], None, 0.7, 3),
    "two bounces in a step": ([0, 0, CENTRE + 0.0002, 1, 0.3, -0.06, 10, 30, 5], None, 0.02, 2),
    "rolling": ([0, 0, CENTRE, 1, 0.3, 0, -15, 50, 5], None, 0.1, 0),
    "coming to rest": ([0, 0, CENTRE + 0.0001, 1, 0.3, -0.03, 10, 30, 5], None, 0.05, 0),
    "past the edge, to the floor": ([0.95, 0, 0.1, 4, 0.3, -1, 10, 30, 5], EDGE, 0.5, 1),
    "beside the table": ([1.05, 0, 0.1, 4, 0.3, -1, 10, 30, 5], EDGE, 0.2, 0),
    "onto the table": ([-1.03, 0, 0.1, 4, 0.3, -4, 10, 30, 5], EDGE, 0.1, 1),
    "off the table within a step": ([0.98, 0, 0.03, 4, 0.3, -1, 10, 30, 5], EDGE, 0.02, 0),
    "onto the table within a step": ([-1.01, 0, 0.03, 4, 0.3, -2, 10, 30, 5], EDGE, 0.02, 1),
    "over the edge, rolling": ([0.95, 0, CENTRE, 2, 0.3, 0, -15, 100, 5], EDGE, 0.2, 0),
    "from below the surface": ([0, 0, CENTRE - 0.003, 4, 0.3, -1, 10, 30, 5], None, 0.05, 1),
}


@pytest.mark.parametrize("name", PATHS)
def test_the_paths_are_what_they_are_called(model, name):
    state, surfaces, end, impacts = PATHS[name]
    start = torch.tensor([state], dtype=torch.float64)
    times = torch.linspace(0.0, end, 150, dtype=torch.float64)
    with torch.no_grad():
        states = torch.cat((start, rollout(model, start, times, surfaces or Surfaces(0.0, -0.76))[0]))
    assert int((torch.diff(states[:, VZ]) > 0.06).sum()) == impacts


def test_far_below_the_floor_there_is_nothing_to_bounce_on(model):
    """A little below it a ball has just gone through; from a depth of 26 m no way leads back to a bounce."""
    state = torch.tensor([[0, 0, -0.8, 4, 0.3, -5, 10, 30, 5], [0, 0, -27, 4, 0.3, -14, 10, 30, 5]]).double()
    covariance, times = 1e-6 * torch.eye(STATE_DIM).double().repeat(2, 1, 1), torch.linspace(0.01, 0.3, 30).double()
    belief = Belief(model, torch.zeros(2).double(), state, covariance)
    found = Propagator(EDGE, ProcessNoise()).rollout(belief, times)
    assert found.states[0, 0, VZ] > 0.0
    with torch.no_grad():
        free = rollout(model, state[1:], times, Surfaces(table_height=-1e4))[0]
    np.testing.assert_allclose(found.states[1], free.numpy(), rtol=1e-12)
    assert np.isfinite(found.covariances).all()


# --- closed forms ------------------------------------------------------------------------------------------------


def kalman_prediction(belief: Belief, dt: float, noise: ProcessNoise) -> tuple[np.ndarray, np.ndarray]:
    """The exact prediction of a ball under its weight alone."""
    transition = np.eye(STATE_DIM)
    transition[POSITION, VELOCITY] = dt * np.eye(3)
    mean = belief.mean @ transition.T
    mean[:, Z] -= 9.81 * dt**2 / 2
    mean[:, VZ] -= 9.81 * dt
    q = noise.acceleration**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    covariance = transition @ belief.covariance @ transition.T
    covariance[:, :6, :6] += np.kron(q, np.eye(3))
    covariance[:, SPIN, SPIN] += noise.spin**2 * dt * np.eye(3)
    return mean, covariance


@pytest.mark.parametrize("cuts", [[0.33], [0.1, 0.33], [0.001, 0.02, 0.02, 0.0913, 0.33]])
def test_linear_motion_is_predicted_exactly_however_time_is_cut(gravity, beliefs, cuts):
    noise = ProcessNoise(acceleration=2.0, spin=30.0)
    belief = beliefs(gravity, RISING, FALLING, time=5.0)
    predicted = Propagator(FAR, noise).rollout(belief, 5.0 + torch.tensor(cuts, dtype=torch.float64))
    mean, covariance = kalman_prediction(belief, 0.33, noise)
    np.testing.assert_allclose(predicted.states[:, -1], mean, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(predicted.covariances[:, -1], covariance, rtol=1e-11, atol=1e-15)


def test_a_bounce_adds_its_noise_at_its_time(gravity, beliefs):
    """Straight down: the noise of the impact has moved the ball for what is left of the time."""
    noise = ProcessNoise(acceleration=1e-9, spin=1e-9, contact_velocity=0.1, contact_tangential=0.3, contact_spin=7.0)
    belief = beliefs(gravity, [0, 0, 0.02 + 9.81 * 0.1**2 / 2, 0, 0, 0, 0, 0, 0])
    belief = replace(belief, covariance=1e-20 * torch.eye(9, dtype=torch.float64)[None])
    at = torch.tensor([0.1501], dtype=torch.float64)
    covariance = Propagator(Surfaces(0.0), noise).rollout(belief, at).covariances[0, 0]
    left = 0.0501  # the ball touches at 0.1 s
    expected = torch.zeros((9, 9), dtype=torch.float64)
    for axis, variance in enumerate((0.1, 0.1, 0.01)):  # tangential: 0.1^2 + 0.3^2
        expected[axis, axis] = variance * left**2
        expected[axis, 3 + axis] = expected[3 + axis, axis] = variance * left
        expected[3 + axis, 3 + axis] = variance
        expected[6 + axis, 6 + axis] = 49.0
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", PATHS)
def test_impact_noise_comes_with_impacts_only(model, beliefs, name):
    state, surfaces, end, impacts = PATHS[name]
    noise = ProcessNoise(acceleration=1e-9, spin=1e-9, contact_velocity=1e-9, contact_spin=100.0)
    belief = beliefs(model, state)
    belief = replace(belief, covariance=np.zeros_like(belief.covariance))
    propagator = Propagator(surfaces or Surfaces(0.0, -0.76), noise)
    variance = propagator.rollout(belief, torch.tensor([end], dtype=torch.float64)).covariances[0, 0, 8, 8]
    share = np.exp(-2 * 0.2 * end)  # the spin about the normal decays only
    assert 1e4 * impacts * share - 1e-6 <= variance <= 1e4 * impacts + 1e-6


# --- the Jacobian ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PATHS)
def test_covariance_goes_through_the_derivative_of_the_rollout(uncertain, beliefs, table, name):
    """One belief for each column j, with covariance e_j e_j': after the rollout it is the outer product of J's column.

    Differences: fourth order with steps of 1e-6 to 1e-3, a thousandth of what the dynamics change over: truncation is
    below 1e-9, rounding near 1e-10 of a step, and three bounces multiply it by less than a thousand. A column is a
    thousand steps wide: narrow enough to stay away from every edge, much wider than the noise.
    """
    state, surfaces, end, _ = PATHS[name]
    surfaces = surfaces or table.surfaces
    belief = beliefs(uncertain, state)
    d = belief.mean.shape[-1]
    steps = torch.tensor((1e-6,) * 3 + (1e-5,) * 3 + (1e-3,) * 3 + (1e-5, 1e-5, 1e-6), dtype=torch.float64)
    scale, dt = torch.diag(steps), torch.full((d,), end, dtype=torch.float64)
    mean = torch.from_numpy(belief.mean).expand(d, -1).clone()
    columns = Belief(uncertain, torch.zeros(d), mean, 1e6 * scale[:, :, None] * scale[:, None])
    with torch.no_grad():
        at = [advance(uncertain, mean + k * scale, dt, surfaces) for k in range(-2, 3)]
    difference = (8 * (at[3] - at[1]) - (at[4] - at[0])) / 12 / steps
    still = ProcessNoise(*[1e-12] * len(fields(ProcessNoise)))
    predicted = Propagator(surfaces, still).forward(columns, dt)
    np.testing.assert_allclose(predicted.mean, at[2], rtol=1e-9, atol=1e-9)
    outer = difference[:, :, None] * difference[:, None]
    covariance = torch.from_numpy(predicted.covariance) / 1e6 / (steps[:, None] * steps)
    error = (covariance - outer).abs() / (1.0 + outer.abs().amax((-1, -2), keepdim=True))
    assert error.max() < 1e-5


def test_monte_carlo_through_a_bounce(uncertain, beliefs, samples, table):
    belief = beliefs(uncertain, FALLING)
    times = torch.tensor([0.1, 0.25, 0.4], dtype=torch.float64)  # the ball touches at 0.14 s
    with torch.no_grad():
        drawn = rollout(uncertain, samples(belief, 4000), times, table.surfaces)
    predicted = table.rollout(belief, times)
    for k in range(len(times)):
        scale = np.sqrt(np.diagonal(predicted.covariances[0, k]))
        mean, covariance = drawn[:, k, :9].mean(0).numpy(), torch.cov(drawn[:, k, :9].T).numpy()
        assert np.abs((mean - predicted.states[0, k]) / scale).max() < 0.1  # 0.016 by chance, the rest is curvature
        assert np.abs((covariance - predicted.covariances[0, k]) / np.outer(scale, scale)).max() < 0.1


def test_monte_carlo_of_the_process_noise(model, beliefs):
    """Noise drawn every millisecond against its closed form, over a bounce."""
    noise = ProcessNoise(acceleration=0.5, spin=20.0, contact_velocity=1e-9, contact_spin=1e-9)
    propagator = Propagator(Surfaces(0.0), noise)
    belief = beliefs(model, FALLING)
    belief = replace(belief, covariance=np.zeros_like(belief.covariance))
    rng, state = torch.Generator().manual_seed(2), torch.from_numpy(belief.mean).expand(3000, -1).clone()
    for _ in range(250):
        with torch.no_grad():
            state = advance(model, state, torch.full((3000,), 1e-3, dtype=torch.float64), propagator.surfaces)
        kick = torch.randn((3000, 6), generator=rng, dtype=torch.float64) * 1e-3**0.5
        state[:, VELOCITY] += 0.5 * kick[:, :3]
        state[:, SPIN] += 20.0 * kick[:, 3:]
    covariance = torch.from_numpy(propagator.forward(belief, [0.25]).covariance[0])
    scale = covariance.diagonal().sqrt()
    assert ((torch.cov(state.T) - covariance) / torch.outer(scale, scale)).abs().max() < 0.1


# --- bookkeeping -------------------------------------------------------------------------------------------------


def test_batch_is_the_same_as_one_by_one(uncertain, beliefs):
    """The batch takes the steps of its longest interval, so that only what does not depend on steps is compared.

    Rolling does, to 1e-4 (and an edge is left at the end of a step); so does the noise of two bounces in a step.
    """
    propagator = Propagator(EDGE, ProcessNoise())
    other = ("rolling", "coming to rest", "over the edge, rolling", "two bounces in a step")
    names = [name for name in PATHS if name not in other]
    batch = beliefs(uncertain, *(PATHS[name][0] for name in names))
    batch = replace(batch, time=np.arange(len(names), dtype=float))
    ends = np.linspace(0.05, 0.6, len(names))
    times = batch.time[:, None] + ends[:, None] * np.array([0.0, 0.3, 0.3, 1.0])
    together = propagator.rollout(batch, times)
    negligible = np.array((1e-3,) * 3 + (0.03,) * 3 + (1.0,) * 3)
    for i, name in enumerate(names):
        one = Belief(uncertain, batch.time[i : i + 1], batch.mean[i : i + 1], batch.covariance[i : i + 1])
        alone = propagator.rollout(one, times[i : i + 1])
        scale = np.sqrt(np.diagonal(alone.covariances[0], axis1=-2, axis2=-1) + negligible**2)
        assert np.abs((together.states[i] - alone.states[0]) / scale).max() < 1e-4, name
        error = (together.covariances[i] - alone.covariances[0]) / (scale[:, :, None] * scale[:, None])
        assert np.abs(error).max() < 0.02, name


def test_covariance_stays_symmetric_and_positive(uncertain, beliefs):
    propagator = Propagator(Surfaces(0.0, -0.76), ProcessNoise())
    belief = beliefs(uncertain, [0, 0, 0.3, 1, 0.3, 1, 10, 30, 5])
    times = torch.arange(1, 600, dtype=torch.float64) / 200
    covariances = propagator.rollout(belief, times).covariances[0]
    np.testing.assert_array_equal(covariances, covariances.swapaxes(-1, -2))
    scale = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    correlations = covariances / (scale[:, :, None] * scale[:, None])
    assert np.linalg.eigvalsh(correlations)[:, 0].min() > -1e-9


def test_wrong_times(model, beliefs, table):
    belief = beliefs(model, FALLING, time=2.0)
    for times, message in (
        (torch.tensor([[1.9]]), "must not lie before"),
        (torch.tensor([[2.2, 2.1]]), "must not decrease"),
        (torch.tensor([[float("nan")]]), "must not decrease"),
        (torch.tensor([[float("inf")]]), "finite"),
        (torch.tensor([[2.1], [2.1]]), r"shape \(1, k\)"),
        (torch.zeros((1, 0)), r"shape \(1, k\)"),
    ):
        with pytest.raises(ValueError, match=message):
            table.rollout(belief, times.double())
    with pytest.raises(ValueError, match="not negative"):
        table.forward(belief, torch.tensor([-0.1]).double())


def test_after_the_longest_motion_a_ball_lies_and_its_doubt_grows(model, beliefs, monkeypatch):
    """Nothing moves then, and the noise of the time that is left is added once, as in flight."""
    longest = 2.0  # of the usual 20 s every step would be computed
    monkeypatch.setattr("ballfg.prediction.propagate.LONGEST_MOTION", longest)
    noise = ProcessNoise(acceleration=0.01, spin=0.5)
    propagator = Propagator(Surfaces(0.0, -0.76), noise)
    belief = beliefs(model, [0, 0, CENTRE, 0.3, 0.0, 0, 0.0, 15.0, 0.0])
    times = torch.tensor([longest, longest + 30.0], dtype=torch.float64)
    last, later = (propagator.forward(belief, time[None]) for time in times)
    assert float(later.time[0]) == pytest.approx(longest + 30.0)
    np.testing.assert_allclose(later.mean, last.mean, rtol=1e-7)
    gained = (later.covariance - last.covariance)[0, :9, :9]
    t, q, w = 30.0, 0.01**2, 0.5**2
    expected = np.diag(np.repeat([q * t**3 / 3, q * t, w * t], 3))
    expected[:3, 3:6] = expected[3:6, :3] = q * t**2 / 2 * np.eye(3)
    np.testing.assert_allclose(gained, expected, rtol=1e-9, atol=1e-9 * float(last.covariance.max()))
