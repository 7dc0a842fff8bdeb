"""Integrates free flight by Runge-Kutta steps of order four, with their exact Jacobian.

The Jacobian is that of the discrete step, not of the differential equation: torch autograd gives the derivative of the
model's rates at the four stages in one batch, and the chain rule through the stages does the rest. It costs
about half of what autograd through the whole step costs.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from ballfg.arrays import Array, Index
from ballfg.dynamics.model import BallModel, Rates
from ballfg.dynamics.motion.limits import MAX_STEP
from ballfg.state import POSITION, SPIN, VELOCITY

HEAVY = 300_000
"""Parameters times states above which arithmetic, not the number of torch calls, dominates a Jacobian's cost."""

RateFunction = Callable[[Tensor], Rates]

_EYE3 = torch.eye(3, dtype=torch.float64)


def derivative(rates: RateFunction, state: Tensor) -> Tensor:
    """(..., 9) time derivative of the state; zero for further columns, which hold constant coefficients."""
    acceleration, spin_rate = rates(state)
    if spin_rate is None:
        return torch.cat((state[..., VELOCITY], acceleration, torch.zeros_like(state[..., SPIN.start :])), dim=-1)
    return torch.cat((state[..., VELOCITY], acceleration, spin_rate, torch.zeros_like(state[..., SPIN.stop :])), dim=-1)


def rk4_step(rates: RateFunction, state: Tensor, h: Tensor, slope: Tensor | None = None) -> Tensor:
    """One Runge-Kutta step of h (..., 1) s from `state` (..., 9); `slope` is its derivative, if known."""
    return stages_of(rates, state, h, slope)[0]


def stages_of(
    rates: RateFunction, state: Tensor, h: Tensor, slope: Tensor | None = None
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The state after a step, and the four states at which the rates were taken."""
    half = h / 2
    k1 = derivative(rates, state) if slope is None else slope
    x2 = torch.addcmul(state, half, k1)
    k2 = derivative(rates, x2)
    x3 = torch.addcmul(state, half, k2)
    k3 = derivative(rates, x3)
    x4 = torch.addcmul(state, h, k3)
    k4 = derivative(rates, x4)
    total = torch.add(k1 + k4, k2 + k3, alpha=2.0)
    return torch.addcmul(state, h / 6, total), (state, x2, x3, x4)


def step_count(dt: Tensor | Array) -> int:
    """Number of equal steps, each at most `MAX_STEP`, that the longest of some intervals (s) needs.

    An interval that is NaN (a contact that never comes) needs none.

    Raises: ValueError: if an interval is infinite.
    """
    durations = dt.detach().abs() if isinstance(dt, Tensor) else np.abs(dt)
    longest = float(durations.max()) if 0 not in durations.shape else 0.0
    if math.isnan(longest):
        longest = max((float(d) for d in durations.reshape(-1) if not math.isnan(d)), default=0.0)
    if math.isinf(longest):
        raise ValueError("dt must be finite; got inf. Check the times.")
    return steps_over(longest)


def steps_over(duration: float) -> int:
    """Number of equal steps, each at most `MAX_STEP` to rounding, that a duration (s) needs; at least one."""
    return max(1, math.ceil(duration / MAX_STEP - 1e-9))


def steps_over_each(durations: Array) -> Index:
    """`steps_over` of each of some durations (n,) s."""
    return np.maximum(1, np.ceil(durations / MAX_STEP - 1e-9)).astype(np.int64)


def fly(model: BallModel, state: Tensor, dt: Tensor) -> Tensor:
    """The state after `dt` of free flight, without surfaces.

    Args:
        model: the ball.
        state: (..., 9).
        dt: (...) s, broadcast against the batch; negative goes back in time.
    Returns: (..., 9), differentiable in the state, in dt and in the model's parameters.
    """
    if not followed(state, dt):
        from ballfg.dynamics.compiled import motion  # which needs the models, and these this file

        calm = model.in_flight
        functions = motion.functions_of(calm)
        if functions is not None:
            return motion.fly(calm, functions, state, dt)
    steps = step_count(dt)
    h = (dt / steps).unsqueeze(-1)
    for _ in range(steps):
        state = rk4_step(model.rates, state, h)
    return state


def followed(*tensors: Tensor | float) -> bool:
    """True if torch must compute: it records derivatives or a trace, or the tensors lie on another device.

    Machine code takes float64 in the memory of the processor.
    """
    if torch.is_grad_enabled() or forward_ad._current_level >= 0:
        return True
    return any(isinstance(t, Tensor) and not is_plain(t) for t in tensors)


def is_plain(tensor: Tensor) -> bool:
    """True if machine code can read a tensor: float64 in the memory of the processor."""
    return type(tensor) is Tensor and tensor.dtype is torch.float64 and tensor.is_cpu


def fly_jacobian(model: BallModel, state: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
    """`fly` and its derivative by the state.

    Args: model: the ball.  state: (..., 9).  dt: (...) s.
    Returns: state after dt (..., 9) and Jacobian (..., 9, 9); both detached from any graph.
    """
    if is_plain(state):
        from ballfg.dynamics.compiled import motion  # which needs the models, and these this file

        functions = motion.functions_of(model)
        if functions is not None:
            return motion.fly_jacobian(model, functions, state, dt)
    state = state.detach()
    steps = step_count(dt)
    h = (dt.detach() / steps).unsqueeze(-1)
    jacobian: Tensor | None = None
    for _ in range(steps):
        with torch.no_grad():
            after, stages = stages_of(model.rates, state, h)
        step = _step_jacobian(model, stages, h)
        jacobian = step if jacobian is None else step @ jacobian
        state = after
    assert jacobian is not None
    return state, jacobian


def _step_jacobian(model: BallModel, stages: tuple[Tensor, ...], h: Tensor) -> Tensor:
    """(..., 9, 9) derivative of one Runge-Kutta step, from the rates' Jacobians A_i at its stages."""
    heavy = model.parameter_count * len(stages) * h.numel() > HEAVY
    a1, a2, a3, a4 = rate_jacobian(model.rates, torch.stack(stages), heavy=heavy)
    whole = h[..., None]
    half = whole / 2
    k2 = a2 + half * (a2 @ a1)
    k3 = a3 + half * (a3 @ k2)
    k4 = a4 + whole * (a4 @ k3)
    jacobian = (whole / 6) * (a1 + 2 * (k2 + k3) + k4)
    jacobian.diagonal(dim1=-2, dim2=-1).add_(1.0)
    return jacobian


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


def batch_jacobian(
    function: Callable[[Tensor], Tensor], state: Tensor, *, outputs: int | None = None
) -> tuple[Tensor, Tensor]:
    """A row-wise function and its derivative, in one autograd call on the batch repeated once per output.

    Args:
        function: maps (..., n, 9) to (..., n, m), each row by itself.
        state: (n, 9).
        outputs: m, where it is known; else one more call finds it.
    Returns: value (n, m) and Jacobian (n, m, 9); both detached.
    """
    if outputs is None:
        with torch.no_grad():
            outputs = function(state).shape[-1]
    leaf = state.detach().expand(outputs, *state.shape).clone().requires_grad_(True)
    with torch.enable_grad():
        value = function(leaf)
    cotangent = torch.eye(outputs, dtype=state.dtype, device=state.device).unsqueeze(1).expand_as(value)
    (rows,) = torch.autograd.grad(value, leaf, cotangent)
    return value[0].detach(), rows.transpose(0, 1)
