"""A small network in place of the aerodynamics, fitted to the analytic model: what a learned model costs."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.dynamics.model import Rates
from ballfg.state import SPIN, STANDARD_GRAVITY, STATE_DIM, VELOCITY

HIDDEN = 80
SPEED_SCALE = 6.0
"""m/s that the network sees as one."""
SPIN_SCALE = 100.0
"""rad/s that the network sees as one."""
FORCE_SCALE = 10.0
"""m/s^2, the network's output of one."""
FIT_SAMPLES = 2000
FIT_ITERATIONS = 600
"""Of L-BFGS; the fit then is off by about a twentieth of the aerodynamic acceleration."""


class NetworkFlight(BallModel):
    """Flight by gravity plus a 9-80-80-3 tanh network of velocity, spin and spin x velocity (7,523 parameters).

    Bounces are another model's. The parameters are frozen: the benchmark estimates states, it learns nothing.

    Args:
        bounces: what a bounce does; its radius and inertia are taken too.
        generator: draws the start weights.
    """

    def __init__(self, bounces: BallModel, generator: torch.Generator) -> None:
        super().__init__(bounces.radius, bounces.inertia_factor)
        self.bounces = bounces
        sizes = (9, HIDDEN, HIDDEN, 3)
        self.layers = nn.ModuleList(nn.Linear(i, o, dtype=torch.float64) for i, o in pairwise(sizes))
        # the tensors themselves: calling modules costs as much as the small products
        self._stack = tuple((layer.weight, layer.bias) for layer in self.layers if isinstance(layer, nn.Linear))
        with torch.no_grad():
            for weight, bias in self._stack:
                spread = 1.0 / math.sqrt(weight.shape[1])
                weight.copy_(spread * torch.randn(weight.shape, generator=generator, dtype=torch.float64))
                bias.zero_()
        scales = [1 / SPEED_SCALE] * 3 + [1 / SPIN_SCALE] * 3 + [1 / (SPEED_SCALE * SPIN_SCALE)] * 3
        self._scale = torch.tensor(scales, dtype=torch.float64)
        self.gravity = torch.tensor([0.0, 0.0, -STANDARD_GRAVITY], dtype=torch.float64)

    def force(self, state: Tensor) -> Tensor:
        """(..., 3) the network's output: aerodynamic acceleration divided by `FORCE_SCALE`."""
        velocity, spin = state[..., VELOCITY], state[..., SPIN]
        x = torch.cat((velocity, spin, torch.linalg.cross(spin, velocity)), dim=-1) * self._scale
        *hidden, last = self._stack
        for weight, bias in hidden:
            x = torch.tanh(nn.functional.linear(x, weight, bias))
        return nn.functional.linear(x, *last)

    def rates(self, state: Tensor) -> Rates:
        """Acceleration in free flight; the spin is constant."""
        return torch.add(self.gravity, self.force(state), alpha=FORCE_SCALE), None

    def bounce(self, state: Tensor) -> Tensor:
        """That of the other model."""
        return self.bounces.bounce(state)


def fitted_network(model: AnalyticModel, iterations: int = FIT_ITERATIONS) -> NetworkFlight:
    """A network fitted to a model's accelerations, in seconds and always to the same weights.

    An unfitted network would make an ill-posed problem, on which a solver's time says nothing.
    """
    generator = torch.Generator().manual_seed(0)
    network = NetworkFlight(model, generator)
    state = torch.zeros((FIT_SAMPLES, STATE_DIM), dtype=torch.float64)
    state[:, VELOCITY] = SPEED_SCALE * torch.randn((FIT_SAMPLES, 3), generator=generator, dtype=torch.float64)
    state[:, SPIN] = SPIN_SCALE * torch.randn((FIT_SAMPLES, 3), generator=generator, dtype=torch.float64)
    with torch.no_grad():
        target = (model.rates(state)[0] - network.gravity) / FORCE_SCALE
    optimizer = torch.optim.LBFGS(
        network.layers.parameters(), max_iter=iterations, history_size=30, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        optimizer.zero_grad()
        value: Tensor = (network.force(state) - target).square().mean()
        value.backward()
        return value

    optimizer.step(loss)
    return network.requires_grad_(False)


def parameter_count(network: NetworkFlight) -> int:
    """Weights and biases of the network."""
    return sum(p.numel() for p in network.layers.parameters())
