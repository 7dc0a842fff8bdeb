"""The launcher factor: its Jacobian, what it refuses, and the estimate that it makes of a spin."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
import torch

from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.factors.batch import Values
from ballfg.factors.bridge import from_gtsam, nonlinear_graph, to_gtsam
from ballfg.factors.check import check_factor
from ballfg.factors.graph import BallGraph, LevenbergMarquardt
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.loss import Loss
from ballfg.factors.prior import state_prior

SETTINGS = np.array([[2.0, 1.0], [0.5, -3.0]])
SIGMA = np.array([[5.0, 6.0, 7.0], [8.0, 9.0, 10.0]])


@pytest.fixture
def embedding() -> SpinEmbedding:
    initial = torch.tensor([[5.0, 50.0, 3.0], [2.0, -4.0, 40.0]], dtype=torch.float64)
    return SpinEmbedding(("topspin", "sidespin"), {}, initial)


@pytest.fixture
def values() -> Values:
    states = np.random.default_rng(1).standard_normal((3, 9)) * np.repeat((1.0, 4.0, 80.0), 3)
    states[2, 3:5] = (0.02, -0.03)  # a ball that goes straight up has hardly a direction of flight
    return Values(states, np.zeros(0))


@pytest.mark.parametrize("states", [[0, 1], [0, 2]])
def test_its_jacobian_is_that_of_differences(states, embedding, values, check_jacobian) -> None:
    kind = LauncherSpinFactors(np.array(states), SETTINGS, embedding, SIGMA, Loss("cauchy"))
    assert check_jacobian(kind, values) < 1e-6
    check_factor(kind, values)


def test_the_residual_is_what_the_settings_say(embedding, values) -> None:
    """A ball that flies along x: topspin turns about y, sidespin about z."""
    states = values.states.copy()
    states[0, 3:9] = (4.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    kind = LauncherSpinFactors(np.array([0]), SETTINGS[:1], embedding, SIGMA[:1])
    spin = 2.0 * np.array([5.0, 50.0, 3.0]) + 1.0 * np.array([2.0, -4.0, 40.0])
    residual = kind.linearize(Values(states, np.zeros(0))).residual[0]
    np.testing.assert_allclose(residual, -spin / SIGMA[0], rtol=1e-4)  # a launch at 4 m/s is 8e-5 short of a direction


def test_spin_and_direction_are_estimated_together(embedding) -> None:
    """Ours and GTSAM's minimum; the spin pulls at the velocity only as far as that is uncertain."""
    start = np.array([0.0, 0.0, 1.0, 4.0, 1.0, 2.0, 0.0, 60.0, 90.0])
    sigma = np.array([0.01] * 3 + [0.4] * 3 + [30.0] * 3)
    kind = LauncherSpinFactors(np.array([0]), SETTINGS[:1], embedding, SIGMA[:1], Loss("huber", 1.0))
    graph, values = BallGraph((state_prior(0, start, sigma), kind)), Values(start[None], np.zeros(0))
    ours = LevenbergMarquardt(tolerance=1e-10).minimize(graph, values).values.states[0]
    factors, _bridges = nonlinear_graph(graph)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-15)
    parameters.setAbsoluteErrorTol(1e-15)
    theirs = from_gtsam(gtsam.LevenbergMarquardtOptimizer(factors, to_gtsam(values), parameters).optimize())
    assert np.abs((ours - theirs.states[0]) / sigma).max() < 1e-5
    assert np.abs((ours - start) / sigma)[3:].max() > 0.1


def test_what_is_refused(embedding) -> None:
    one = np.array([0])
    with pytest.raises(ValueError, match=r"settings and sigma must have shapes \(1, 2\) and \(1, 3\)"):
        LauncherSpinFactors(one, SETTINGS[:1, :1], embedding, SIGMA[:1])
    with pytest.raises(ValueError, match=r"settings and sigma must have shapes \(1, 2\) and \(1, 3\)"):
        LauncherSpinFactors(one, SETTINGS[:1], embedding, SIGMA)
    with pytest.raises(ValueError, match=r"sigma must be positive; got 0\. Leave out settings that say nothing"):
        LauncherSpinFactors(one, SETTINGS[:1], embedding, 0.0 * SIGMA[:1])


def test_spread(embedding) -> None:
    kind = LauncherSpinFactors(np.array([0, 1]), SETTINGS, embedding, SIGMA)
    assert kind.log_spread() == pytest.approx(np.log(SIGMA).sum(), rel=1e-15)
