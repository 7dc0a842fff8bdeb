"""One Runge-Kutta step of free flight with its derivatives up to the second, for gradients through an estimate.

Autograd through a step goes through its four stages one after the other, and back, once for every derivative. But where
the stages lie is known after the step, and so are the rates' Jacobians A_k there. With them the tangents of the stages
are constant matrices times the tangent of the state; what autograd still has to do - the rates' second derivatives, and
those by the model's parameters - it does for all stages in one batch.
"""

from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ballfg.dynamics.compiled import motion
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.flight_step import derivative, rate_jacobians, runge_kutta
from ballfg.dynamics.motion.integrate import is_plain
from ballfg.dynamics.motion.limits import STAGES


def flight_step(model: BallModel, state: Tensor, h: Tensor) -> Tensor:
    """`rk4_step` of a model's rates, to be differentiated up to twice by the state and the parameters.

    Args: state: (n, 9).  h: (n, 1) s, a constant.
    Returns: (n, 9).
    """
    work = _Work(model, state.detach(), h)
    after: Tensor = _Step.apply(state, work)
    return after + _StepByParameters.apply(work, *work.parameters) if work.parameters else after


_Curved = tuple[Tensor, list[Tensor | None]]
"""(4, n, 9) the Hessians of c_k . d_k times the tangents t_k, and the mixed derivatives by each parameter; each stage
counts for its share."""


class _Work:
    """The values that all derivatives of a step share.

    Attributes:
        after: (n, 9) the state after the step.  parameters: of the model, those that are learned.
        shares: (4, n, 1) s, the part of the step for which each stage's slope counts.
        stages, jacobians: (4, n, 9) where slopes were taken, (4, n, 9, 9) the derivatives of the rates there.
    """

    def __init__(self, model: BallModel, state: Tensor, h: Tensor) -> None:
        self.h, self.model = h, model
        self.parameters = [p for p in model.parameters() if p.requires_grad]
        self.after, self.stages, self.jacobians = _step(model, state, h)
        self.shares = h / 6.0 * h.new_tensor([1.0, *(weight for _, weight in STAGES)])[:, None, None]
        self._pushed: tuple[Tensor, Tensor] | None = None
        self._bent: tuple[Tensor, Tensor] | None = None
        self._curved: tuple[Tensor, _Curved] | None = None

    @cached_property
    def maps(self) -> tuple[Tensor, Tensor]:
        """(n, 9, 9) and (n, 36, 9): derivatives of the state after the step, and of all stages, by that before."""
        eye = torch.eye(self.after.shape[-1], dtype=self.after.dtype, device=self.after.device)
        first = self.jacobians[0]
        after, stages = runge_kutta(lambda k, x: self.jacobians[k] @ x, eye, self.h[..., None], first)
        return after, torch.cat((eye.expand_as(first), *stages[1:]), dim=1)

    @cached_property
    def transposed(self) -> Tensor:
        """(4, n, 9, 9) `jacobians`, each transposed."""
        return self.jacobians.mT.contiguous()

    @cached_property
    def traced(self) -> tuple[Tensor, Tensor]:
        """The stages (4, n, 9) as a leaf and the derivatives there, with a graph."""
        leaf = self.stages.clone().requires_grad_(True)
        with torch.enable_grad():
            return leaf, derivative(self.model.rates, leaf)

    def cotangents(self, u: Tensor, bent: Tensor | None = None) -> Tensor:
        """Cotangents c_k (4, n, 9) of the stages' slopes over their `shares`.

        Args: u: (n, 9) that of the state after the step.  bent: (4, n, 9) what acts on the stages besides.
        """

        def slope(k: int, c: Tensor) -> Tensor:
            behind = _times(self.transposed[-1 - k], c)
            return behind if bent is None else behind + bent[-1 - k]

        return torch.stack(runge_kutta(slope, u, self.h)[1][::-1])

    def pushed(self, upstream: Tensor) -> Tensor:
        """`cotangents` of the last `upstream`, which several nodes of the graph ask for."""
        if self._pushed is None or self._pushed[0] is not upstream:
            self._pushed = upstream, self.cotangents(upstream)
        return self._pushed[1]

    def bent(self, upstream: Tensor) -> Tensor:
        """(4, n, 9) A_k^T c_k stage by stage, with a graph; kept for the last `upstream`."""
        if self._bent is None or self._bent[0] is not upstream:
            leaf, rates = self.traced
            with torch.enable_grad():
                (gradient,) = torch.autograd.grad(rates, leaf, self.pushed(upstream), create_graph=True)
            self._bent = upstream, gradient
        return self._bent[1]

    def curved(self, upstream: Tensor, v: Tensor, learn: bool) -> _Curved:
        """What bends along one v (n, 9) of the state, with derivatives by the parameters where they `learn`.

        Cached for the last v: two nodes of the graph ask for the same, that of the parameters first.
        """
        kept = self._curved
        if kept is None or kept[0].data_ptr() != v.data_ptr() or self._bent is None or self._bent[0] is not upstream:
            tangents = _times(self.maps[1], v).view(len(v), len(self.stages), -1).transpose(0, 1).contiguous()
            bent, *rest = self._derivatives(self.bent(upstream), self.shares * tangents, [self.traced[0]], learn)
            self._curved = kept = (v, (torch.zeros_like(tangents) if bent is None else bent, rest))
        return kept[1]

    def by_parameters(self, cotangents: Tensor) -> list[Tensor | None]:
        """Derivatives by the parameters of the stages' slopes times their cotangents (4, n, 9)."""
        return self._derivatives(self.traced[1], self.shares * cotangents, [], learn=True)

    def _derivatives(self, output: Tensor, weight: Tensor, leaves: list[Tensor], learn: bool) -> list[Tensor | None]:
        wanted = [*leaves, *(self.parameters if learn else ())]
        if not output.requires_grad:  # rates that are linear in the state, with nothing to learn
            return [None] * len(wanted)
        return list(torch.autograd.grad(output, wanted, weight, retain_graph=True, allow_unused=True))


def _step(model: BallModel, state: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The state (n, 9) after a step, its stages (4, n, 9), and the Jacobians (4, n, 9, 9) of the rates there."""
    functions = motion.functions_of(model) if is_plain(state) else None
    if functions is None:
        with torch.no_grad():
            after, stages = runge_kutta(lambda _, x: derivative(model.rates, x), state, h)
        return after, torch.stack(stages), rate_jacobians(model, torch.stack(stages))
    moving, jacobians = motion.Moving(model, functions, state.detach().numpy(), state.shape[-1]), []

    def slope(_: int, x: Tensor) -> Tensor:
        slopes, by_state = moving.slopes(x.numpy())
        jacobians.append(torch.from_numpy(by_state))
        return torch.from_numpy(slopes)

    after, stages = runge_kutta(slope, state, h)
    return after, torch.stack(stages), torch.stack(jacobians)


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
        gradient: Tensor = _Pull.apply(state, upstream[0], work, constant)
        if work.parameters and torch.is_grad_enabled():
            gradient = gradient + _PullByParameters.apply(work, constant, *work.parameters)
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
        return None, *work.by_parameters(work.cotangents(upstream[0]))


class _Pull(torch.autograd.Function):
    """J^T u as a function of the state and of u."""

    @staticmethod
    def forward(ctx: Any, state: Tensor, upstream: Tensor, work: _Work, constant: Tensor) -> Tensor:
        ctx.work, ctx.upstream = work, constant
        return _times(work.maps[0].mT, constant)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        work: _Work = ctx.work
        after, stages = work.maps
        gradient = None
        if ctx.needs_input_grad[0]:
            bent, _ = work.curved(ctx.upstream, v[0], learn=False)
            gradient = _times(stages.mT, bent.transpose(0, 1).reshape(len(v[0]), -1))
        return gradient, _times(after, v[0]), None, None


class _PullByParameters(torch.autograd.Function):
    """Zero, with the derivative of J^T u by the parameters."""

    @staticmethod
    def forward(ctx: Any, work: _Work, upstream: Tensor, *parameters: Tensor) -> Tensor:
        ctx.work, ctx.upstream = work, upstream
        return torch.zeros_like(work.after)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        work: _Work = ctx.work
        bent, direct = work.curved(ctx.upstream, v[0], learn=True)
        moved = work.by_parameters(work.cotangents(torch.zeros_like(bent[0]), bent / work.shares))
        return None, None, *(a if b is None else b if a is None else a + b for a, b in zip(direct, moved, strict=True))
