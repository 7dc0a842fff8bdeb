"""Measures the cost of the gradient through an estimate of 80 observations with a network for the dynamics."""

from collections.abc import Mapping
from functools import partial
from typing import Final

import torch

from ballfg.benchmarks.speed.stopwatch import Stopwatch
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.factors.batch import Noise, Values
from ballfg.factors.graph import BallGraph, Minimum
from ballfg.learning.end_to_end.end_to_end import SOLUTION_TOLERANCE
from ballfg.learning.end_to_end.solving import TRAINING
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients, GaussNewtonFactors
from ballfg.learning.gradient.implicit import GaussNewtonGradient, GradientMethod, ImplicitGradient, UnrolledGradient
from ballfg.learning.gradient.objective import BatchObjective

METHODS: Final[Mapping[str, GradientMethod]] = {
    "implicit": ImplicitGradient(),
    "gauss-newton": GaussNewtonGradient(),
    "unrolled": UnrolledGradient(8),
}
EXACT: Final = 1e-12  # Tolerance of the linear solution in the reference gradient; training takes `SOLUTION_TOLERANCE`


def time_gradients(watch: Stopwatch, model: LearnedModel, graph: BallGraph, start: Values) -> None:
    """Forward: from the first guess to the minimum. Backward: from a derivative by all states to one by all weights.

    Building the torch objective belongs to the backward pass.
    """
    minimum, kind = TRAINING.minimize(graph, start), model.architecture.kind
    forward = watch.time(kind, "forward_time", lambda: TRAINING.minimize(graph, start))
    exact = backward(model, graph, minimum, ImplicitGradient(), EXACT)
    for name, method in METHODS.items():
        row, once = f"{kind}, {name}", partial(backward, model, graph, minimum, method)
        found = once()
        figure = watch.time(row, "backward_time", once)
        watch.add(row, "backward_over_forward", figure.value / forward.value, watch.runs)
        watch.add(row, "gradient_error", float((found - exact).norm() / exact.norm()))


def backward(
    model: LearnedModel,
    graph: BallGraph,
    minimum: Minimum,
    method: GradientMethod,
    tolerance: float = SOLUTION_TOLERANCE,
) -> torch.Tensor:
    """Gradient of a fixed linear function of all states by all weights, as one vector."""
    assert minimum.step is not None
    objective = BatchObjective([graph], [minimum.values])
    layout, weights = objective.layout, [p for p in model.parameters() if p.requires_grad]
    factors = GaussNewtonFactors([minimum.step.root])
    point = method(
        lambda: layout.pack([minimum.values]),
        lambda at: objective.gradient(at, Noise()),
        ConjugateGradients(factors, layout.owners(), tolerance),
        weights,
    )
    direction = torch.cos(torch.arange(len(point), dtype=point.dtype))
    gradients = torch.autograd.grad((direction * point).sum(), weights, allow_unused=True)
    pairs = zip(weights, gradients, strict=True)
    return torch.cat([(torch.zeros_like(weight) if g is None else g).reshape(-1) for weight, g in pairs])
