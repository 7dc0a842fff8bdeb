"""Contacts with a horizontal surface: when the ball touches it, and the flow through one or more contacts.

The contact time is a function of the state. Newton's iteration finds it without a graph; the last two steps run with
one. A Newton step from the solution has the solution's exact first derivative, two steps have its derivatives up
to the third, so that both the saltation term of a Jacobian and the Hessian of a loss come out of autograd right
(docs/derivations/contact.md).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.integrate import batch_jacobian, derivative, fly, fly_jacobian
from ballfg.dynamics.model import BallModel
from ballfg.state import VZ, Z

NEWTON_STEPS = 12
"""Upper bound on the search; four are enough from the parabola's guess."""
TIME_TOLERANCE = 1e-13
"""s. The search stops when no contact time moves by more."""
TYPICAL_FALL = 9.81
"""m/s^2, for the first guess only."""
MIN_SPEED = 1e-6
"""m/s. Least normal speed that a Newton step divides by; a ball that grazes more gently is at its apex."""


def contact_time(model: BallModel, state: Tensor, height: Tensor | float) -> Tensor:
    """Time until the falling ball touches a surface, on the branch on which it moves down.

    Args: model: the ball.  state: (..., 9).  height: m, scalar or (...).
    Returns: (...) s; negative when the ball is already below the surface on its way down. NaN where the ball,
        in free flight, never gets to that height. Differentiable in the state and the parameters.
    """
    with torch.no_grad():
        tau = _parabola_time(model.gap(state, height), state[..., VZ])
        for _ in range(NEWTON_STEPS):
            move = _newton_step(model, state, height, tau)
            tau = tau + move
            if not bool((move.abs() > TIME_TOLERANCE).any()):
                break
    for _ in range(2):
        tau = tau + _newton_step(model, state, height, tau)
    return tau


def _parabola_time(height_above: Tensor, vz: Tensor) -> Tensor:
    """(...) s at which a parabola comes down to the surface; NaN where it stays below."""
    return (vz + (vz.square() + 2 * TYPICAL_FALL * height_above).sqrt()) / TYPICAL_FALL


def _newton_step(model: BallModel, state: Tensor, height: Tensor | float, tau: Tensor) -> Tensor:
    at = fly(model, state, torch.nan_to_num(tau))
    speed = at[..., VZ].clamp_max(-MIN_SPEED)
    return -model.gap(at, height) / speed + 0.0 * tau  # keeps NaN


def fly_through(
    model: BallModel, state: Tensor, dt: Tensor, heights: tuple[Tensor | float, ...]
) -> tuple[Tensor, Tensor]:
    """The state after `dt`, with one contact after another on the way, at surfaces that the caller names.

    The contacts happen whether or not their times lie inside [0, dt]: a contact a little before or after the
    interval is a smooth continuation, so that an estimator can move through it. Whether it lies inside is for the
    caller to see in the returned times.

    Args:
        model: the ball.
        state: (n, 9).
        dt: (n,) s.
        heights: for each contact, in order, the surface's height in m, scalar or (n,).
    Returns: state after dt (n, 9), contact times since the start (n, len(heights)) s.
    """
    elapsed = torch.zeros_like(dt)
    times = []
    for height in heights:
        tau = contact_time(model, state, height)
        state = model.bounce(fly(model, state, tau))
        elapsed = elapsed + tau
        times.append(elapsed)
    after = fly(model, state, dt - elapsed)
    return after, torch.stack(times, dim=-1) if times else dt.new_zeros((*dt.shape, 0))


def fly_through_jacobian(
    model: BallModel, state: Tensor, dt: Tensor, heights: tuple[Tensor | float, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """`fly_through` and its derivative by the state, composed of flight, saltation and impact.

    Args: as for `fly_through`.
    Returns: state after dt (n, 9), contact times (n, k) s, Jacobian (n, 9, 9); detached from any graph.
    """
    state = state.detach()
    jacobian = torch.eye(state.shape[-1], dtype=state.dtype).expand(*state.shape, -1)
    elapsed = torch.zeros_like(dt)
    elapsed_by_state = torch.zeros_like(state).unsqueeze(-2)  # (n, 1, 9)
    times = []
    for height in heights:
        with torch.no_grad():
            tau = contact_time(model, state, height)
        before, flight = fly_jacobian(model, state, tau)
        jacobian = flight @ jacobian
        rate = derivative(model.rates, before).detach()
        # at the contact the gap is zero: d gap + vz d tau = 0
        _, gap_by_state = batch_jacobian(lambda at, height=height: model.gap(at, height).unsqueeze(-1), before)
        tau_by_state = -(gap_by_state @ jacobian) / rate[..., Z : Z + 1].unsqueeze(-1)
        jacobian = jacobian + rate.unsqueeze(-1) * tau_by_state
        state, impact = batch_jacobian(model.bounce, before)
        jacobian = impact @ jacobian
        elapsed = elapsed + tau
        elapsed_by_state = elapsed_by_state + tau_by_state
        times.append(elapsed)
    after, flight = fly_jacobian(model, state, dt - elapsed)
    rate = derivative(model.rates, after).detach()
    jacobian = flight @ jacobian - rate.unsqueeze(-1) * elapsed_by_state
    return after, torch.stack(times, dim=-1) if times else dt.new_zeros((*dt.shape, 0)), jacobian
