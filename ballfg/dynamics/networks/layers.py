"""Defines three small networks, whose hidden states pass from step to step plain, added or multiplied.

All map features (..., f) to outputs (..., o) in float64. The last layer starts at zero, so that an untrained network
gives zero; the others start at random from a generator.
"""

import math
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

from ballfg.dynamics.networks.polynomial import Weights, evaluate, evaluation_cost, expand

NetworkKind = Literal["mlp", "skip", "mnn"]

EXPANSION_ROWS = 256
"""Number of states from which an MNN is evaluated as a polynomial: computing the coefficients costs as much as running
it on 100 to 300 states, with or without derivatives."""


class MLP(nn.Module):
    """h_1 = tanh(F_1 x), h_k = tanh(F_k h_{k-1}), y = G h_N."""

    def __init__(self, inputs: int, outputs: int, width: int, depth: int, generator: torch.Generator) -> None:
        super().__init__()
        sizes = [inputs] + [width] * depth
        self.hidden = nn.ModuleList(_linear(a, b, generator) for a, b in pairwise(sizes))
        self.last = _zero_linear(width, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (..., o) from features (..., f)."""
        for layer in self.hidden:
            x = torch.tanh(layer(x))
        return self.last(x)


class Skip(nn.Module):
    """h_0 = F_0 x, h_k = tanh(F_k h_{k-1}) + h_{k-1}, y = G h_N (He et al. 2016)."""

    def __init__(self, inputs: int, outputs: int, width: int, depth: int, generator: torch.Generator) -> None:
        super().__init__()
        self.first = _linear(inputs, width, generator)
        self.hidden = nn.ModuleList(_linear(width, width, generator) for _ in range(depth))
        self.last = _zero_linear(width, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (..., o) from features (..., f)."""
        h = self.first(x)
        for layer in self.hidden:
            h = torch.tanh(layer(h)) + h
        return self.last(h)


class MNN(nn.Module):
    """h_0 = F_0 x, h_k = h_0 F(h_{k-1}) + h_{k-1} with one F for all k, y = G h_N.

    A polynomial of degree N + 1 in the features; for many states it is written out as one. Source: Q. Xiao, Z. Wu,
    M. Gombolay 2024, section III-B-3.
    """

    def __init__(self, inputs: int, outputs: int, width: int, depth: int, generator: torch.Generator) -> None:
        super().__init__()
        self.depth = depth
        self.first = _linear(inputs, width, generator)
        self.step = _linear(width, width, generator)
        self.last = _zero_linear(width, outputs)
        self._least_rows = EXPANSION_ROWS if evaluation_cost(inputs, outputs, depth) < depth * width**2 else math.inf

    def write_out(self) -> None:
        """Uses the polynomial for single states too, where that is cheaper with known coefficients."""
        if math.isfinite(self._least_rows):
            self._least_rows = 0

    def forward(self, x: Tensor) -> Tensor:
        """Outputs (..., o) from features (..., f)."""
        if x.numel() >= self._least_rows * x.shape[-1]:
            coefficients = expand(_weights(self.first), _weights(self.step), _weights(self.last), self.depth)
            return evaluate(coefficients, x, self.depth)
        start = h = self.first(x)
        for _ in range(self.depth):
            h = torch.addcmul(h, start, self.step(h))
        return self.last(h)


NETWORKS: dict[NetworkKind, type[MLP] | type[Skip] | type[MNN]] = {"mlp": MLP, "skip": Skip, "mnn": MNN}


def _weights(layer: nn.Linear) -> Weights:
    return layer.weight, layer.bias


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """Weights and bias uniform within 1/sqrt(inputs), torch's own default, but drawn from a generator."""
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, dtype=torch.float64)
    bound = 1.0 / math.sqrt(inputs)
    for parameter in (layer.weight, layer.bias):
        nn.init.uniform_(parameter, -bound, bound, generator=generator)
    return layer


def _zero_linear(inputs: int, outputs: int) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, dtype=torch.float64)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
