"""Predictions of balls that come down near the edge of the table."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import njit
from scipy.stats import norm

from ballfg.dynamics import Surfaces, rollout
from ballfg.dynamics.compiled.beliefs.course import Course
from ballfg.dynamics.compiled.beliefs.edges import come_down, falls_past
from ballfg.dynamics.compiled.flight import laws_of
from ballfg.dynamics.motion.integrate import fly
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import Propagator, apex
from tests.prediction.conftest import NEARLY_EXACT

NOISY = ProcessNoise()
START = [0.0, 0.0, 0.25, 4.0, 0.3, -1.0, 10.0, 30.0, 5.0]
LANDS = 0.54
"""m, x at which it comes down."""
TIMES = torch.tensor([0.1, 0.16, 0.25, 0.35], dtype=torch.float64)  # it comes down at 0.14 s


def with_end(x: float, sigma: float = 0.0) -> Surfaces:
    return Surfaces(0.0, -5.0, (-np.inf, x, -np.inf, np.inf), (0.0, sigma, 0.0, 0.0))


def second_moments(drawn: torch.Tensor, about: np.ndarray) -> np.ndarray:
    difference = drawn[:, :, :9].numpy() - about
    return np.einsum("nki,nkj->kij", difference, difference) / len(difference)


@pytest.mark.parametrize("beyond", [-0.015, -0.003, 0.003, 0.015])
@pytest.mark.parametrize("sigma", [0.0, 0.02])
def test_the_spread_is_that_of_both_ways(model, beliefs, samples, beyond, sigma):
    """Against balls drawn from the belief and ends drawn from theirs, all about the predicted mean."""
    belief = beliefs(model, START)
    predicted = Propagator(with_end(LANDS + beyond, sigma), NEARLY_EXACT).rollout(belief, TIMES)
    drawn = samples(belief, 2000)
    ends = LANDS + beyond + sigma * norm.ppf((np.arange(20) + 0.5) / 20)
    with torch.no_grad():
        flown = torch.cat([rollout(model, drawn[k::20], TIMES, with_end(float(ends[k]))) for k in range(20)])
    expected = second_moments(flown, predicted.states[0])
    for k in (0, 2, 3):  # at 0.16 s some have not come down yet
        ratio = np.sqrt(np.diagonal(predicted.covariances[0, k]) / np.diagonal(expected[k]))
        assert np.abs(ratio - 1.0)[[0, 1, 2, 3, 4, 5]].max() < 0.2


@pytest.mark.parametrize("beyond", [0.004, 0.006, 0.012])
def test_a_bounce_of_just_now_is_in_doubt_with_the_end_of_the_table(model, beliefs, samples, beyond):
    """At some stamps a part of the balls still falls, a part has bounced, and a part has passed the end."""
    belief, times = beliefs(model, START), torch.linspace(0.139, 0.149, 6, dtype=torch.float64)
    predicted = Propagator(with_end(LANDS + beyond), NEARLY_EXACT).rollout(belief, times)
    with torch.no_grad():
        flown = rollout(model, samples(belief, 4000), times, with_end(LANDS + beyond))
    expected = second_moments(flown, predicted.states[0])
    ratio = np.sqrt(np.diagonal(predicted.covariances[0], axis1=1, axis2=2) / np.diagonal(expected, axis1=1, axis2=2))
    assert np.abs(ratio - 1.0)[:, [0, 1, 3, 5]].max() < 0.3
    assert np.abs(ratio - 1.0)[:, 2].max() < 0.4
    assert 0.01 < float((flown[:, -1, 5] < 0.0).double().mean()) < 0.5  # pass the end


def test_far_from_an_edge_nothing_changes(model, beliefs):
    belief = beliefs(model, START)
    plain = Propagator(Surfaces(0.0, -5.0), NEARLY_EXACT).rollout(belief, TIMES)
    far = Propagator(with_end(LANDS + 0.5, 0.02), NEARLY_EXACT).rollout(belief, TIMES)
    np.testing.assert_array_equal(far.covariances, plain.covariances)
    beside = Propagator(with_end(LANDS - 0.5, 0.02), NEARLY_EXACT).rollout(belief, TIMES)
    falling = Propagator(Surfaces(-5.0), NEARLY_EXACT).rollout(belief, TIMES)
    np.testing.assert_allclose(beside.covariances, falling.covariances, rtol=1e-9, atol=1e-15)


STEPS = {
    "falls past, some bounce": [0.9, 0.0, 0.03, 4.0, 0.3, -2.0, 10.0, 30.0, 5.0],
    "bounces, some fall past": [0.98, 0.0, 0.03, 0.5, 0.3, -2.0, 10.0, 30.0, 5.0],
    "turns beside the table, a little above it": [1.3, 0.0, 0.012, 1.0, 0.3, 0.05, 10.0, 30.0, 5.0],
    "has touched it already": [0.5, 0.0, 0.009, 2.0, 0.3, -2.5, 10.0, 30.0, 5.0],
}


@pytest.mark.parametrize("start", STEPS.values(), ids=STEPS)
def test_a_step_of_machine_code_is_that_of_torch(uncertain, beliefs, start):
    propagator, h = Propagator(with_end(1.0 if start[0] != 0.9 else 0.935, 0.01), NOISY), 0.02
    belief = beliefs(uncertain, start)
    course, hard = propagator._carrier(belief).carry(Course.start(belief.mean, belief.covariance), np.array([[h]]))
    mean, covariance, _ = propagator._touch(uncertain, belief.mean[0], belief.covariance[0], h)
    assert not hard.any()
    np.testing.assert_allclose(course.mean[1, 0], mean, rtol=0, atol=1e-9)
    sigmas = np.sqrt(np.diagonal(covariance))
    assert (np.abs(course.covariance[1, 0] - covariance) / np.outer(sigmas, sigmas)).max() < 1e-6


def test_a_ball_that_has_touched_the_table_rises_to_its_apex(uncertain, beliefs):
    propagator = Propagator(with_end(1.0), NOISY)
    touched, later = beliefs(uncertain, STEPS["has touched it already"]), torch.tensor([0.02], dtype=torch.float64)
    one, other = apex(propagator, touched, 1.0), apex(propagator, propagator.forward(touched, later), 1.0)
    assert one.time == pytest.approx(other.time, abs=1e-7)
    np.testing.assert_allclose(one.state, other.state, atol=1e-6)
    sigmas = np.sqrt(np.diagonal(other.covariance)) + 1e-9
    difference = np.abs(one.covariance - other.covariance) / np.outer(sigmas, sigmas)
    assert difference.max() < 0.02  # within a step the noise of an impact does not decay with velocity and spin


def test_known_places_at_a_known_edge_have_no_doubt(model, beliefs):
    belief = beliefs(model, START)
    belief = replace(belief, covariance=np.zeros_like(belief.covariance))
    for beyond in (-0.01, 0.01):
        predicted = Propagator(with_end(LANDS + beyond), NEARLY_EXACT).rollout(belief, TIMES)
        assert np.abs(predicted.covariances).max() < 1e-12


@njit
def both_ways(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, x, world, touch, covariance, h, after, spread):
    """Time at which a ball comes down on the table at z = 0, and whether it falls past; from Python's arguments."""
    laws = laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws)
    tau = come_down(laws, x, 0.0, world, touch)
    return tau, falls_past(laws, covariance, touch, tau, h, world, after, spread)


def test_the_spread_of_both_ways_is_that_of_the_states(uncertain, beliefs):
    """Share times the outer product of the two ways' difference; coefficients are the same on both."""
    belief = beliefs(uncertain, STEPS["falls past, some bounce"])
    propagator, h = Propagator(with_end(0.925), NOISY), 0.02
    carrier = propagator._carrier(belief)
    covariance, spread, after, touch = np.zeros((18, 18)), np.zeros((18, 18)), np.ones(18), np.empty(9)
    covariance[:9, :9] = belief.covariance[0, :9, :9]
    start, mean = belief.mean[0, :9].copy(), torch.from_numpy(belief.mean)
    with torch.no_grad():
        end = torch.tensor([h], dtype=torch.float64)
        after[:9] = fly(uncertain, mean, end)[0, :9]
        bounced = rollout(uncertain, mean, end, Surfaces(0.0))[0, 0, :9].numpy()
    _, past = both_ways(*carrier._given, start, carrier._world, touch, covariance, h, after, spread)
    assert past
    assert not spread[9:].any()
    assert not spread[:, 9:].any()
    share = norm.cdf((0.925 - touch[0]) / np.sqrt(along(touch) @ covariance[:9, :9] @ along(touch)))
    difference = bounced - after[:9]
    np.testing.assert_allclose(spread[:9, :9], share * np.outer(difference, difference), rtol=1e-6, atol=1e-12)


def along(touch):
    """How a change of the state moves the place along x at which a ball comes down."""
    normal = np.zeros(9)
    normal[0], normal[2] = 1.0, -touch[3] / touch[5]
    return normal
