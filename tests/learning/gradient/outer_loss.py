"""A loss on an estimate, and its gradient with respect to what the estimate depends on."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ballfg.learning.gradient.implicit import GradientMethod, ImplicitGradient
from tests.learning.estimates import Estimates, ball

TRUTH = ball(gravity={}, drag={"k": 0.15}, magnus={"k": 0.004}, restitution={"e": 0.88}, friction={"mu": 0.25})
SPREAD = torch.tensor([1e-3] * 3 + [5e-2] * 3 + [10.0] * 3, dtype=torch.float64)
"""m, m/s, rad/s: about what the states are uncertain by."""


def outer(point: Tensor, coefficients: int = 0) -> Tensor:
    """A loss on all states (and coefficients) that is neither linear nor the same for any two."""
    split = len(point) - coefficients
    states = point[:split].view(-1, 9)
    weights = torch.randn(states.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    along = (weights * states / SPREAD).sum() / 100.0
    return along + 0.01 * along.square() + (point[split:] * 7.0).square().sum()


def gradients(
    estimates: Estimates, leaves: Sequence[Tensor], method: GradientMethod | None = None, coefficients: int = 0
) -> tuple[Tensor, ...]:
    point = estimates.attached(method or ImplicitGradient(), leaves)
    return torch.autograd.grad(outer(point, coefficients), leaves)
