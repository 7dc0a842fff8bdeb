"""One Runge-Kutta step of free flight, its Jacobian, and its derivatives up to the second.

The scheme is written once, for the slope of anything: of a state, of tangents, and of cotangents, since it is its own
adjoint (docs/derivations/integration.md). Autograd through a step goes through its four stages one after the other, and
back, once for every derivative. But where the stages lie is known after the step, and so are the rates' Jacobians A_k
there. All else is the same scheme with small matrices for the slope; what autograd still has to do - the rates' second
derivatives, and those by the model's parameters - it does for all stages in one batch.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ballfg.dynamics.model import BallModel, Rates
from ballfg.dynamics.motion.limits import STAGES
from ballfg.state import POSITION, SPIN, VELOCITY

HEAVY = 300_000
"""Parameters times states from which arithmetic, not the number of torch calls, decides what a Jacobian costs."""

RateFunction = Callable[[Tensor], Rates]

_EYE3 = torch.eye(3, dtype=torch.float64)


def runge_kutta(
    slope: Callable[[int, Tensor], Tensor], start: Tensor, h: Tensor, first: Tensor | None = None
) -> tuple[Tensor, list[Tensor]]:
    """One step of h from `start` by the classic scheme of order four, of which machine code has a twin (`step_on`).

    Args: slope: of stage k at a point.  h: s, broadcast against `start`.  first: the slope at `start`, where known.
    Returns: the point after the step, and the four at which slopes were taken.
    """
    k = slope(0, start) if first is None else first
    total, stages = k, [start]
    for number, (reach, weight) in enumerate(STAGES, start=1):
        stages.append(torch.addcmul(start, reach * h, k))
        k = slope(number, stages[-1])
        total = torch.add(total, k, alpha=weight)
    return torch.addcmul(start, h / 6.0, total), stages


def derivative(rates: RateFunction, state: Tensor) -> Tensor:
    """(..., 9) time derivative of the state; zero for further columns, which hold constant coefficients."""
    acceleration, spin_rate = rates(state)
    if spin_rate is None:
        return torch.cat((state[..., VELOCITY], acceleration, torch.zeros_like(state[..., SPIN.start :])), dim=-1)
    return torch.cat((state[..., VELOCITY], acceleration, spin_rate, torch.zeros_like(state[..., SPIN.stop :])), dim=-1)


def rk4_step(rates: RateFunction, state: Tensor, h: Tensor, slope: Tensor | None = None) -> Tensor:
    """One Runge-Kutta step of h (..., 1) s from `state` (..., 9); `slope` is its derivative, where that is known."""
    return runge_kutta(lambda _, x: derivative(rates, x), state, h, slope)[0]


def step_jacobian(model: BallModel, state: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """The state (..., 9) after a step of h (..., 1) s, and its derivative (..., 9, 9) by that before; both detached."""
    with torch.no_grad():
        after, stages = runge_kutta(lambda _, x: derivative(model.rates, x), state, h)
    jacobians = _rate_jacobians(model, torch.stack(stages))
    eye = torch.eye(state.shape[-1], dtype=state.dtype, device=state.device)
    return after, runge_kutta(lambda k, x: jacobians[k] @ x, eye, h[..., None], jacobians[0])[0]


def _rate_jacobians(model: BallModel, stages: Tensor) -> Tensor:
    """(4, ..., 9, 9) of the rates at the stages (4, ..., 9)."""
    heavy = model.parameter_count * stages[..., 0].numel() > HEAVY
    return rate_jacobian(model.rates, stages, heavy=heavy)


def rate_jacobian(rates: RateFunction, state: Tensor, *, heavy: bool = False) -> Tensor:
    """(..., 9, 9) derivative of `derivative(rates, state)` by the state.

    A batch repeated three times gives all rows of a 3-vector's Jacobian in one backward pass: for effects of a few
    operations the number of calls decides, not the size of the batch. For a `heavy` model, a network, arithmetic
    decides: it is evaluated once, and the backward pass is batched over the rows.
    """
    width = state.shape[-1]
    jacobian = state.new_zeros((*state.shape, width))
    eye = _EYE3.to(state.device)
    jacobian[..., POSITION, VELOCITY] = eye
    leaf = (state.detach() if heavy else state.detach().expand(3, *state.shape)).requires_grad_(True)
    with torch.enable_grad():
        acceleration, spin_rate = rates(leaf)
    for value, rows in ((acceleration, VELOCITY), (spin_rate, SPIN)):
        if value is None or not value.requires_grad:  # gravity alone does not depend on the state
            continue
        cotangent = eye.view(3, *(1,) * (state.dim() - 1), 3).expand(3, *state.shape[:-1], 3)
        (by_state,) = torch.autograd.grad(
            value, leaf, cotangent, retain_graph=True, allow_unused=True, is_grads_batched=heavy
        )
        if by_state is not None:
            jacobian[..., rows, :] = by_state.movedim(0, -2)
    return jacobian


def flight_step(model: BallModel, state: Tensor, h: Tensor) -> Tensor:
    """`rk4_step` of a model's rates, to be differentiated up to twice by the state and the parameters.

    Args: state: (n, 9).  h: (n, 1) s, a constant.
    Returns: (n, 9).
    """
    work = _Work(model, state.detach(), h)
    after: Tensor = _Step.apply(state, work)
    return after + _StepByParameters.apply(work, *work.parameters) if work.parameters else after


class _Work:
    """The values that all derivatives of a step share.

    Attributes:
        after: (n, 9) the state after the step.  parameters: of the model, those that are learned.
        shares: (4, n, 1) s, the part of the step for which each stage's slope counts.
    """

    def __init__(self, model: BallModel, state: Tensor, h: Tensor) -> None:
        self.h, self.model = h, model
        self.parameters = [p for p in model.parameters() if p.requires_grad]
        with torch.no_grad():
            self.after, stages = runge_kutta(lambda _, x: derivative(model.rates, x), state, h)
        self._stages = torch.stack(stages)
        self.shares = h / 6.0 * h.new_tensor([1.0, *(weight for _, weight in STAGES)])[:, None, None]
        self._bent: tuple[Tensor, Tensor] | None = None
        self._curved: tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]] | None = None

    @cached_property
    def jacobians(self) -> Tensor:
        """(4, n, 9, 9) of the rates at the stages."""
        return _rate_jacobians(self.model, self._stages)

    @cached_property
    def transposed(self) -> Tensor:
        """(4, n, 9, 9) `jacobians`, each transposed."""
        return self.jacobians.mT.contiguous()

    @cached_property
    def traced(self) -> tuple[Tensor, Tensor]:
        """The stages (4, n, 9) as a leaf and the derivatives there, with a graph."""
        leaf = self._stages.clone().requires_grad_(True)
        with torch.enable_grad():
            return leaf, derivative(self.model.rates, leaf)

    def bent(self, cotangents: Tensor, upstream: Tensor) -> Tensor:
        """(4, n, 9) A_k^T c_k stage by stage, with a graph; kept for the `upstream` that the c_k belong to."""
        if self._bent is None or self._bent[0] is not upstream:
            leaf, rates = self.traced
            with torch.enable_grad():
                (gradient,) = torch.autograd.grad(rates, leaf, cotangents, create_graph=True)
            self._bent = upstream, gradient
        return self._bent[1]

    def tangents(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Tangents t_k (4, n, 9) of the stages for one v (n, 9) of the state, and that of the state after the step."""
        after, stages = runge_kutta(lambda k, t: _times(self.jacobians[k], t), v, self.h)
        return torch.stack(stages), after

    def cotangents(self, u: Tensor, bent: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Cotangents c_k (4, n, 9) of the stages' slopes over their `shares`, and that of the state, (n, 9).

        Args: u: (n, 9) that of the state after the step.  bent: (4, n, 9) what acts on the stages besides.
        """

        def slope(k: int, c: Tensor) -> Tensor:
            behind = _times(self.transposed[-1 - k], c)
            return behind if bent is None else behind + bent[-1 - k]

        before, stages = runge_kutta(slope, u, self.h)
        return torch.stack(stages[::-1]), before

    def curved(self, cotangents: Tensor, upstream: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Along v (n, 9): tangents of the stages and of the state after; changes of the cotangents and of the gradient.

        Cached for the last v: two nodes of the graph ask for the same.
        """
        kept = self._curved
        if kept is None or kept[0].data_ptr() != v.data_ptr() or self._bent is None or self._bent[0] is not upstream:
            tangents, after = self.tangents(v)
            moved, gradient = self.cotangents(torch.zeros_like(v), _bend(self, cotangents, upstream, tangents))
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
        return None, *_by_parameters(work, [work.traced[1]], [work.shares * cotangents])


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
        return None, None, None, *_by_parameters(work, outputs, [work.shares * moved, work.shares * tangents])


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
