"""Fits a small network to the analytic model's aerodynamics, as a stand-in for learned models."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from ballfg.dynamics import AnalyticModel, BallModel
from ballfg.dynamics.model import Rates
from ballfg.state import SPIN, STANDARD_GRAVITY, STATE_DIM, VELOCITY

HIDDEN = 80
SPEED_SCALE = 6.0  # m/s that the network sees as one
SPIN_SCALE = 100.0  # rad/s that the network sees as one
FORCE_SCALE = 10.0  # m/s^2, the network's output of one
SCALES = torch.tensor([SPEED_SCALE] * 3 + [SPIN_SCALE] * 3 + [SPEED_SCALE * SPIN_SCALE] * 3, dtype=torch.float64)
GRAVITY = torch.tensor([0.0, 0.0, -STANDARD_GRAVITY], dtype=torch.float64)
FIT_SAMPLES = 2000
FIT_ITERATIONS = 600  # Iterations of L-BFGS; the fit then errs by about a twentieth of the aerodynamic acceleration


class NetworkFlight(BallModel):
    """Flight by gravity plus a 9-80-80-3 tanh network of velocity, spin and spin x velocity (7,523 parameters).

    Bounces are another model's.

    Args:
        bounces: the model of bounces, with its radius and inertia.
        weights, biases: of linear layers from 9 inputs, as of `features`, to the acceleration, tanh between them.
    """

    def __init__(self, bounces: BallModel, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
        super().__init__(bounces.radius, bounces.inertia_factor)
        self.bounces = bounces
        self.weights = nn.ParameterList(weights).requires_grad_(False)
        self.biases = nn.ParameterList(biases).requires_grad_(False)
        # the tensors themselves: asking modules for them costs as much as the small products
        self._hidden = tuple(zip(weights[:-1], biases[:-1], strict=True))
        self._last = (weights[-1], biases[-1])

    def rates(self, state: Tensor) -> Rates:
        """Acceleration in free flight; the spin is constant."""
        x = features(state)
        for weight, bias in self._hidden:
            x = torch.tanh(nn.functional.linear(x, weight, bias))
        return nn.functional.linear(x, *self._last), None

    def after_bounce(self, state: Tensor) -> Tensor:
        """That of the other model."""
        return self.bounces.after_bounce(state)


def features(state: Tensor) -> Tensor:
    """(..., 9) what the network sees of a state: velocity, spin, spin x velocity."""
    velocity, spin = state[..., VELOCITY], state[..., SPIN]
    return torch.cat((velocity, spin, torch.linalg.cross(spin, velocity)), dim=-1)


def fitted_network(model: AnalyticModel, iterations: int = FIT_ITERATIONS) -> NetworkFlight:
    """A network fitted to a model's accelerations, in seconds and always to the same weights.

    An unfitted network would make an ill-posed problem, on which a solver's time says nothing.
    """
    generator = torch.Generator().manual_seed(0)
    first, second, last = layers = [nn.Linear(i, o, dtype=torch.float64) for i, o in pairwise((9, HIDDEN, HIDDEN, 3))]
    with torch.no_grad():
        for layer in layers:
            spread = 1.0 / math.sqrt(layer.in_features)
            layer.weight.copy_(spread * torch.randn(layer.weight.shape, generator=generator, dtype=torch.float64))
            layer.bias.zero_()
    network = nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), last)
    state = torch.zeros((FIT_SAMPLES, STATE_DIM), dtype=torch.float64)
    state[:, VELOCITY] = SPEED_SCALE * torch.randn((FIT_SAMPLES, 3), generator=generator, dtype=torch.float64)
    state[:, SPIN] = SPIN_SCALE * torch.randn((FIT_SAMPLES, 3), generator=generator, dtype=torch.float64)
    with torch.no_grad():
        target = (model.rates(state)[0] - GRAVITY) / FORCE_SCALE
    seen = features(state) / SCALES
    optimizer = torch.optim.LBFGS(
        network.parameters(), max_iter=iterations, history_size=30, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        optimizer.zero_grad()
        value: Tensor = (network(seen) - target).square().mean()
        value.backward()
        return value

    optimizer.step(loss)
    weights = [layer.weight.detach().clone() for layer in layers]
    biases = [layer.bias.detach().clone() for layer in layers]
    weights[0] /= SCALES  # scales of inputs and output, and gravity, are folded into the first and the last layer
    weights[-1] *= FORCE_SCALE
    biases[-1] = FORCE_SCALE * biases[-1] + GRAVITY
    return NetworkFlight(model, weights, biases)


def parameter_count(network: NetworkFlight) -> int:
    """Weights and biases of the network."""
    return sum(p.numel() for p in (*network.weights, *network.biases))
