"""One Runge-Kutta step of free flight and its Jacobian.

The scheme is written once, for the slope of anything: of a state, of tangents, and of cotangents, since it is its own
adjoint (docs/derivations/integration.md).
"""

from collections.abc import Callable

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
    jacobians = rate_jacobians(model, torch.stack(stages))
    eye = torch.eye(state.shape[-1], dtype=state.dtype, device=state.device)
    return after, runge_kutta(lambda k, x: jacobians[k] @ x, eye, h[..., None], jacobians[0])[0]


def rate_jacobians(model: BallModel, stages: Tensor) -> Tensor:
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
