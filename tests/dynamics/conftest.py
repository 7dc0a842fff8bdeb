from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from ballfg.dynamics import EFFECTS, AnalyticModel, BallModel, Surfaces
from ballfg.dynamics.model import Rates


@pytest.fixture
def model(every_effect: AnalyticModel) -> AnalyticModel:
    return every_effect


@pytest.fixture
def build() -> Callable[..., AnalyticModel]:
    """A model of the named effects: build(gravity={"g": 9.81}, drag={"k": 0.1})."""

    def make(**effects: dict[str, float]) -> AnalyticModel:
        return AnalyticModel([EFFECTS[name](**values) for name, values in effects.items()])

    return make


@pytest.fixture
def states() -> Callable[..., Tensor]:
    """Seeded random states (n, 9) of a ball about 0.3 m over the table that flies towards +x and falls."""

    def make(n: int, seed: int = 0) -> Tensor:
        rng = torch.Generator().manual_seed(seed)
        unit = torch.rand((n, 9), generator=rng, dtype=torch.float64) * 2 - 1
        centre = torch.tensor((0.0, 0.0, 0.3, 5.0, 0.0, -1.5, 0.0, 0.0, 0.0), dtype=torch.float64)
        spread = torch.tensor((1.0, 0.5, 0.1, 2.0, 1.0, 1.0, 150.0, 300.0, 150.0), dtype=torch.float64)
        return centre + spread * unit

    return make


class NetworkModel(BallModel):
    """A learned ball: a small network adds to gravity, another to the bounce."""

    def __init__(self) -> None:
        super().__init__(0.02)
        self.air = nn.Sequential(nn.Linear(6, 16), nn.Tanh(), nn.Linear(16, 6)).double()
        self.surface = nn.Sequential(nn.Linear(6, 16), nn.Tanh(), nn.Linear(16, 6)).double()
        rng = torch.Generator().manual_seed(3)
        for p in self.parameters():
            p.data = 0.3 * torch.randn(p.shape, generator=rng, dtype=torch.float64)

    def rates(self, state: Tensor) -> Rates:
        scaled = state[..., 3:9] / torch.tensor((5.0, 5.0, 5.0, 100.0, 100.0, 100.0), dtype=torch.float64)
        out = self.air(scaled)
        return out[..., :3] - 9.8 * torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64), 10 * out[..., 3:]

    def after_bounce(self, state: Tensor) -> Tensor:
        velocity = state[..., 3:6] * torch.tensor((0.7, 0.7, -0.9), dtype=torch.float64)
        change = self.surface(state[..., 3:9] / 100)
        spin = state[..., 6:9] + 20 * change[..., 3:]
        return torch.cat((state[..., :3], velocity[..., :2] + 0.1 * change[..., :2], velocity[..., 2:], spin), dim=-1)


@pytest.fixture
def network() -> NetworkModel:
    return NetworkModel()


@pytest.fixture(params=["analytic", "network"])
def any_model(request: pytest.FixtureRequest) -> BallModel:
    name = "model" if request.param == "analytic" else "network"
    return request.getfixturevalue(name)


@pytest.fixture
def differences() -> Callable[[Callable[[Tensor], Tensor], Tensor], Tensor]:
    """Jacobian (n, m, d) of a row-wise function by fourth-order central differences.

    Steps 1e-3 of each column's scale: truncation near 1e-12 of the fifth derivative, rounding near 1e-13 / 1e-3.
    """

    def jacobian(function: Callable[[Tensor], Tensor], state: Tensor) -> Tensor:
        columns = []
        with torch.no_grad():
            for j in range(state.shape[-1]):
                step = torch.zeros(state.shape[-1], dtype=state.dtype)
                step[j] = (1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3, 1e-1, 1e-1, 1e-1)[j]
                near = function(state + step) - function(state - step)
                far = function(state + 2 * step) - function(state - 2 * step)
                columns.append((8 * near - far) / (12 * step[j]))
        return torch.stack(columns, dim=-1)

    return jacobian


@pytest.fixture
def table() -> Surfaces:
    return Surfaces(0.0, -0.76)
