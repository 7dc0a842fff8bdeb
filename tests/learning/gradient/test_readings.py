"""The gradient through estimates of tracks with radar speeds and a spin, against problems that are solved anew."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.estimation import RadarSpeed, SpinReading
from ballfg.learning.gradient.implicit import ImplicitGradient
from tests.learning.estimates import Estimates, directional, measured, usual_ball

SAME = 1e-6
SPREAD = torch.tensor([1e-3] * 3 + [5e-2] * 3 + [10.0] * 3, dtype=torch.float64)
"""m, m/s, rad/s: about what the states are uncertain by."""


@pytest.fixture(scope="module")
def estimates() -> Estimates:
    """Speeds on all tracks, some of them late, one of them 0.5 m/s off; a spin on the second track only."""
    tracks = []
    for k, track in enumerate(measured(usual_ball())):
        rng, at = np.random.default_rng(k), np.arange(1, len(track) - 1, 2)
        steps = np.diff(track.positions, axis=0) / np.diff(track.times)[:, None]
        values = np.linalg.norm(steps[at], axis=1) + 0.05 * rng.standard_normal(len(at))
        values[2] += 0.5
        beside = [RadarSpeed(at, values, 0.08, rng.uniform(0.0, 0.003, len(at)) * (k > 0))]
        beside += [SpinReading([6], [[5.0, -70.0, 40.0]], 12.0)] * (k == 1)
        tracks.append(track.observed(*beside))
    return Estimates(usual_ball(), tracks)


def outer(point: torch.Tensor) -> torch.Tensor:
    """A loss on all states that is neither linear nor the same for any two."""
    states = point.view(-1, 9)
    weights = torch.randn(states.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    along = (weights * states / SPREAD).sum() / 100.0
    return along + 0.01 * along.square()


@pytest.mark.parametrize("name", ["flight.gravity.g", "flight.drag.k", "flight.magnus.k", "bounce.restitution.e"])
def test_gradient_by_a_parameter_is_that_of_differences(estimates: Estimates, name: str) -> None:
    leaf = dict(estimates.model.named_parameters())[name]
    (found,) = torch.autograd.grad(outer(estimates.attached(ImplicitGradient(), [leaf])), [leaf])
    direction = torch.full_like(leaf, 1e-3) * leaf.detach().abs()
    expected = directional(lambda: outer(estimates.point()), [leaf], [direction], 1.0)
    assert float((found * direction).sum()) == pytest.approx(expected, rel=SAME)


def test_speeds_move_the_estimate(estimates: Estimates) -> None:
    """The readings weigh: without them the gradient is another one."""
    alone = Estimates(usual_ball(), measured(usual_ball()))
    slopes = []
    for one in (estimates, alone):
        leaf = dict(one.model.named_parameters())["flight.drag.k"]
        slopes += torch.autograd.grad(outer(one.attached(ImplicitGradient(), [leaf])), [leaf])
    assert abs(float(slopes[0] / slopes[1]) - 1) > 0.01
