"""Differentiates a Runge-Kutta step twice at the cost of one evaluation of the rates instead of four.

Autograd through a step goes through its four stages one after the other, and back, once for every derivative. But where
the stages lie is known after the step, and so are the rates' Jacobians A_k there. All else is the chain rule of the
stages, in small matrices; what autograd still has to do - the rates' second derivatives, and those by the model's
parameters - it does for all stages in one batch. With t_k the tangents and c_k the cotangents of the stages' rates d_k,
the gradient of u . F is u + sum A_k^T c_k, and its derivative along v collects A_k^T dc_k + (grad^2 c_k . d_k) t_k.
"""

from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.integrate import HEAVY, derivative, rate_jacobian, stages_of


def flight_step(model: BallModel, state: Tensor, h: Tensor) -> Tensor:
    """`integrate.rk4_step` of a model's rates, to be differentiated up to twice by the state and the parameters.

    Args: model: the ball.  state: (n, 9).  h: (n, 1) s, a constant.
    Returns: (n, 9).
    """
    work = _Work(model, state.detach(), h)
    after: Tensor = _Step.apply(state, work)
    return after + _StepByParameters.apply(work, *work.parameters) if work.parameters else after


class _Work:
    """The values that all derivatives of a step share.

    Attributes:
        after: (n, 9) the state after the step.
        parameters: the learned parameters of the model.
    """

    def __init__(self, model: BallModel, state: Tensor, h: Tensor) -> None:
        self.h, self.rates = h, model.rates
        self.parameters = [p for p in model.parameters() if p.requires_grad]
        with torch.no_grad():
            self.after, stages = stages_of(model.rates, state, h)
        self._stages = torch.stack(stages)
        self._bent: tuple[Tensor, Tensor] | None = None
        self._curved: tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]] | None = None
        self._heavy = model.parameter_count * self._stages.shape[0] * self._stages.shape[1] > HEAVY

    @cached_property
    def jacobians(self) -> Tensor:
        """(4, n, 9, 9) of the rates at the stages."""
        return rate_jacobian(self.rates, self._stages, heavy=self._heavy)

    @cached_property
    def transposed(self) -> Tensor:
        """(4, n, 9, 9) `jacobians`, each transposed."""
        return self.jacobians.mT.contiguous()

    @cached_property
    def traced(self) -> tuple[Tensor, Tensor]:
        """The stages (4, n, 9) as a leaf and the derivatives there, with a graph."""
        leaf = self._stages.clone().requires_grad_(True)
        with torch.enable_grad():
            return leaf, derivative(self.rates, leaf)

    def bent(self, cotangents: Tensor, upstream: Tensor) -> Tensor:
        """(4, n, 9) sum_k A_k^T c_k stage by stage, with a graph; cached for the `upstream` of the c_k."""
        if self._bent is None or self._bent[0] is not upstream:
            leaf, rates = self.traced
            with torch.enable_grad():
                (gradient,) = torch.autograd.grad(rates, leaf, cotangents, create_graph=True)
            self._bent = upstream, gradient
        return self._bent[1]

    def tangents(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Tangents t_k (4, n, 9) of the stages and of the state after the step, for a tangent v (n, 9) of the state."""
        a, h, half = self.jacobians, self.h, self.h / 2
        rates, stages = [_times(a[0], v)], [v]
        for k, reach in ((1, half), (2, half), (3, h)):
            stages.append(v + reach * rates[-1])
            rates.append(_times(a[k], stages[-1]))
        after = v + h / 6 * (rates[0] + 2 * (rates[1] + rates[2]) + rates[3])
        return torch.stack(stages), after

    def cotangents(self, u: Tensor | None, pulled: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Cotangents c_k (4, n, 9) of the stages' rates and of the state (n, 9), for one of the state after the step.

        Args: u: (n, 9) that cotangent; None for zero.  pulled: (4, n, 9) further ones of the stages; None for zero.
        """
        a, h, half = self.transposed, self.h, self.h / 2
        zero = torch.zeros_like(self.after)
        sixth = zero if u is None else h / 6 * u
        third = sixth if u is None else 2.0 * sixth

        def back(k: int, c: Tensor) -> Tensor:
            behind = _times(a[k], c)
            return behind if pulled is None else behind + pulled[k]

        c4 = sixth
        x4 = back(3, c4)
        c3 = torch.addcmul(third, h, x4)
        x3 = back(2, c3)
        c2 = torch.addcmul(third, half, x3)
        x2 = back(1, c2)
        c1 = torch.addcmul(sixth, half, x2)
        total = back(0, c1) + x2 + x3 + x4
        return torch.stack((c1, c2, c3, c4)), total if u is None else u + total

    def curved(self, cotangents: Tensor, upstream: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Along v (n, 9): tangents of the stages and of the state after; changes of the cotangents and of the gradient.

        Cached for the last v: two nodes of the graph ask for the same.
        """
        kept = self._curved
        if kept is None or kept[0].data_ptr() != v.data_ptr() or self._bent is None or self._bent[0] is not upstream:
            tangents, after = self.tangents(v)
            moved, gradient = self.cotangents(None, _bend(self, cotangents, upstream, tangents))
            self._curved = kept = (v, (tangents, after, moved, gradient))
        return kept[1]


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


class _Step(torch.autograd.Function):
    """The step as a function of the state."""

    @staticmethod
    def forward(ctx: Any, state: Tensor, work: _Work) -> Tensor:
        ctx.save_for_backward(state)
        ctx.work = work
        return work.after

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (state,) = ctx.saved_tensors
        work: _Work = ctx.work
        constant = upstream[0].detach()
        cotangents, pulled = work.cotangents(constant)
        gradient: Tensor = _Pull.apply(state, upstream[0], work, constant, cotangents, pulled)
        if work.parameters and torch.is_grad_enabled():
            gradient = gradient + _PullByParameters.apply(work, constant, cotangents, *work.parameters)
        return gradient, None


class _StepByParameters(torch.autograd.Function):
    """Zero, with the derivative by the parameters: a separate node that autograd can skip."""

    @staticmethod
    def forward(ctx: Any, work: _Work, *parameters: Tensor) -> Tensor:
        ctx.work = work
        return torch.zeros_like(work.after)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        work: _Work = ctx.work
        cotangents, _ = work.cotangents(upstream[0])
        return None, *_by_parameters(work, [work.traced[1]], [cotangents])


class _Pull(torch.autograd.Function):
    """J^T u as a function of the state and of u."""

    @staticmethod
    def forward(
        ctx: Any, state: Tensor, upstream: Tensor, work: _Work, constant: Tensor, cotangents: Tensor, pulled: Tensor
    ) -> Tensor:
        ctx.work, ctx.upstream, ctx.cotangents = work, constant, cotangents
        return pulled

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        work: _Work = ctx.work
        _, after, _, gradient = work.curved(ctx.cotangents, ctx.upstream, v[0])
        return gradient, after, None, None, None, None


class _PullByParameters(torch.autograd.Function):
    """Zero, with the derivative of J^T u by the parameters."""

    @staticmethod
    def forward(ctx: Any, work: _Work, upstream: Tensor, cotangents: Tensor, *parameters: Tensor) -> Tensor:
        ctx.work, ctx.upstream, ctx.cotangents = work, upstream, cotangents
        return torch.zeros_like(work.after)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        work: _Work = ctx.work
        tangents, _, moved, _ = work.curved(ctx.cotangents, ctx.upstream, v[0])
        outputs = [work.traced[1], work.bent(ctx.cotangents, ctx.upstream)]
        return None, None, None, *_by_parameters(work, outputs, [moved, tangents])


def _bend(work: _Work, cotangents: Tensor, upstream: Tensor, tangents: Tensor) -> Tensor:
    """(4, n, 9) the Hessians of c_k . d_k times t_k."""
    gradient = work.bent(cotangents, upstream)
    if not gradient.requires_grad:  # rates that are linear in the state, with nothing to learn
        return torch.zeros_like(gradient)
    leaf, _ = work.traced
    (bent,) = torch.autograd.grad(gradient, leaf, tangents, retain_graph=True, allow_unused=True)
    return torch.zeros_like(gradient) if bent is None else bent


def _by_parameters(work: _Work, outputs: list[Tensor], weights: list[Tensor]) -> tuple[Tensor | None, ...]:
    kept = [(output, weight) for output, weight in zip(outputs, weights, strict=True) if output.requires_grad]
    return torch.autograd.grad(
        [output for output, _ in kept],
        work.parameters,
        [weight for _, weight in kept],
        retain_graph=True,
        allow_unused=True,
    )
