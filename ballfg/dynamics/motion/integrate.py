"""Free flight over any time, in equal Runge-Kutta steps, and the exact Jacobian of those steps."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ballfg.dynamics.compiled import motion
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion import by_machine_code
from ballfg.dynamics.motion.flight_step import rk4_step, step_jacobian
from ballfg.dynamics.motion.limits import step_count


def fly(model: BallModel, state: Tensor, dt: Tensor) -> Tensor:
    """The state after `dt` of free flight, without surfaces.

    Args: state: (..., 9).  dt: (...) s, broadcast against the batch; negative goes back in time.
    Returns: (..., 9), differentiable in the state, in dt and in the model's parameters.
    """
    if not followed(state, dt):
        calm = model.in_flight
        functions = motion.functions_of(calm)
        if functions is not None:
            return by_machine_code.fly(calm, functions, state, dt)
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

    Args: state: (..., 9).  dt: (...) s.
    Returns: state after dt (..., 9) and Jacobian (..., 9, 9); both detached from any graph.
    """
    if is_plain(state):
        functions = motion.functions_of(model)
        if functions is not None:
            return by_machine_code.fly_jacobian(model, functions, state, dt)
    state = state.detach()
    steps = step_count(dt)
    h = (dt.detach() / steps).unsqueeze(-1)
    jacobian: Tensor | None = None
    for _ in range(steps):
        state, step = step_jacobian(model, state, h)
        jacobian = step if jacobian is None else step @ jacobian
    assert jacobian is not None
    return state, jacobian


def batch_jacobian(
    function: Callable[[Tensor], Tensor], state: Tensor, *, outputs: int | None = None
) -> tuple[Tensor, Tensor]:
    """A row-wise function and its derivative, in one autograd call on the batch repeated once per output.

    Args:
        function: maps (..., n, 9) to (..., n, m), each row by itself.  state: (n, 9).
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
