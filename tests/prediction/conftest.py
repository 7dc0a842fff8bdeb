from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces, nominal_model
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import BallModel
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import Belief, Propagator
from ballfg.prediction.state import World

NEARLY_EXACT = ProcessNoise(acceleration=1e-9, spin=1e-9, contact_velocity=1e-9, contact_spin=1e-9)
UNCERTAIN = {"flight.drag.k": 0.005, "bounce.restitution.e": 0.004, "bounce.table_height.offset": 0.002}
FALLING = np.array([0.0, 0.0, 0.3, 3.0, 0.0, -0.5, 0.0, 0.0, 0.0])
"""A ball above a table, in SI units."""
SIGMAS = torch.tensor((0.002, 0.003, 0.002, 0.02, 0.03, 0.02, 2.0, 3.0, 2.0), dtype=torch.float64)


@pytest.fixture(scope="module")
def world():
    return World(nominal_model("table_tennis").requires_grad_(False), Surfaces(0.0))


@pytest.fixture
def model() -> AnalyticModel:
    """A ball that grips in every bounce of these tests: the kink between sliding and gripping is far."""
    values = {
        "gravity": {"g": 9.81},
        "drag": {"k": 0.13},
        "magnus": {"k": 0.003},
        "spin_decay": {"rate": 0.2},
        "restitution": {"e": 0.9},
        "friction": {"mu": 1.0},
        "table_height": {"offset": -0.004},
    }
    return AnalyticModel([EFFECTS[name](**v) for name, v in values.items()])


@pytest.fixture
def gravity() -> AnalyticModel:
    return AnalyticModel([EFFECTS["gravity"](g=9.81), EFFECTS["restitution"](e=0.9)])


@pytest.fixture
def uncertain(model: AnalyticModel) -> AugmentedModel:
    return AugmentedModel(model, tuple(UNCERTAIN))


@pytest.fixture
def table() -> Propagator:
    """A table without end, the floor below, and a ball that follows its model."""
    return Propagator(Surfaces(0.0, -0.76), NEARLY_EXACT)


@pytest.fixture
def beliefs() -> Callable[..., Belief]:
    """beliefs(model, state, ...): one ball each, with correlated small uncertainty in states and coefficients."""

    def make(model: BallModel, *states: list[float], time: float = 0.0) -> Belief:
        mean = torch.tensor(states, dtype=torch.float64)
        sigma = SIGMAS
        if isinstance(model, AugmentedModel):
            values = dict(model.model.named_parameters())
            mean = model.append(
                mean, torch.tensor([float(values[name].detach()) for name in model.names], dtype=torch.float64)
            )
            sigma = torch.cat((SIGMAS, torch.tensor([UNCERTAIN[name] for name in model.names], dtype=torch.float64)))
        rng = torch.Generator().manual_seed(4)
        d = len(sigma)
        mix = torch.eye(d, dtype=torch.float64) + 0.3 * torch.randn((d, d), generator=rng, dtype=torch.float64)
        correlation = mix @ mix.T
        scale = sigma / correlation.diagonal().sqrt()
        covariance = scale[:, None] * correlation * scale
        times = torch.full((len(mean),), time, dtype=torch.float64)
        return Belief(model, times, mean, covariance.expand(len(mean), -1, -1).clone())

    return make


@pytest.fixture
def samples() -> Callable[[Belief, int], Tensor]:
    """Seeded draws (count, d) from a belief of one ball."""

    def draw(belief: Belief, count: int) -> Tensor:
        rng = torch.Generator().manual_seed(7)
        mean, root = torch.from_numpy(belief.mean), torch.linalg.cholesky(torch.from_numpy(belief.covariance[0]))
        return mean + torch.randn((count, mean.shape[-1]), generator=rng, dtype=torch.float64) @ root.T

    return draw
