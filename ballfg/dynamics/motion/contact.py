"""Finds the times of contacts with a surface and computes the flow through one or more contacts.

The contact time is a function of the state. A search finds it without a graph; two Newton steps then run with one. A
Newton step from the solution has the solution's exact first derivative, two steps have its derivatives up
to the third, so that both the saltation term of a Jacobian and the Hessian of a loss come out of autograd right
(docs/derivations/contact.md).
"""

import math

import torch
from torch import Tensor

from ballfg.dynamics.compiled import motion
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion import by_machine_code, limits
from ballfg.dynamics.motion.flight_step import rk4_step
from ballfg.dynamics.motion.integrate import batch_jacobian, fly, fly_jacobian, followed
from ballfg.state import Z


def contact_time(
    model: BallModel, state: Tensor, height: Tensor | float, longest: Tensor | float = limits.LONGEST_FALL
) -> Tensor:
    """Time until the falling ball touches a surface, on the branch on which it moves down.

    Args: state: (..., 9).  height: m, scalar or (...).  longest: s, scalar or (...), how far to look.
    Returns: (...) s; negative when the ball is already below the surface on its way down. NaN where the ball,
        in free flight, does not come down to that height within `longest`. Differentiable in the state and the
        parameters.
    """
    with torch.no_grad():
        tau = _found(model, state, height, longest)
    if torch.is_grad_enabled():
        for _ in range(2):
            tau = tau + _newton_step(model, state, height, tau)
    return tau


def _found(model: BallModel, state: Tensor, height: Tensor | float, longest: Tensor | float) -> Tensor:
    """`contact_time` without derivatives."""
    if not followed(state, height, longest):
        calm = model.in_flight
        functions = motion.functions_of(calm)
        if functions is not None:
            return by_machine_code.contact_time(calm, functions, state, height, longest)
    tau = _search(model, state, height, torch.zeros_like(state[..., Z]), longest)
    if bool(tau.isnan().any()):  # rare: lift above the weight, near misses, or no contact at all
        start = _scan(model, state, height, tau.isnan(), longest)
        scanned = _search(model, state, height, start, longest)
        tau = torch.where(tau.isnan(), scanned, tau)
    return tau


def _search(model: BallModel, state: Tensor, height: Tensor | float, start: Tensor, longest: Tensor | float) -> Tensor:
    """Contact times (...) s near the times `start`, each step solving the parabola through the ball's motion there.

    NaN where the search does not arrive, or starts at NaN.
    """
    tau, lost = torch.nan_to_num(start), start.isnan()
    at = state if not bool(tau.any()) else fly(model, state, tau)
    for _ in range(limits.SEARCH_STEPS):
        h, vz = model.gap(at, height), model.gap_rate(at)
        fall = -model.gap_acceleration(at)
        used = fall.clamp_min(limits.LEAST_FALL)
        square = vz.square() + 2 * used * h
        root = square.clamp_min(0.0).sqrt()
        falling = vz < 0  # each form of the root where it does not cancel; the apex where the parabola stays below
        move = torch.where(falling & (square > 0), 2 * h / (root - vz).clamp_min(1e-300), (vz + root) / used)
        error = (limits.TYPICAL_JERK / 6 * move.abs() + (used - fall).abs() / 2) * move.square()
        arrived = (falling & (square > 0) & (error < limits.TIME_TOLERANCE * vz.abs())) | (
            h.abs() < limits.GAP_TOLERANCE
        ) & (move.abs() < limits.MIN_SPEED)
        tau = tau + move
        lost |= ~(tau.abs() <= longest)
        if bool((arrived | lost).all()):
            break
        tau = tau.masked_fill(lost, 0.0)
        at = fly(model, state, tau)
    return tau.masked_fill(lost | ~arrived, torch.nan)


def _scan(model: BallModel, state: Tensor, height: Tensor | float, wanted: Tensor, longest: Tensor | float) -> Tensor:
    """Times (...) s within one step of the contact: small steps, back in time for a ball that falls below the surface.

    NaN where the ball is not `wanted` or turns before it gets there.
    """
    found = torch.full_like(state[..., Z], torch.nan)
    h = model.gap(state, height)
    step = torch.where((h < 0) & (model.gap_rate(state) < 0), -limits.MAX_STEP, limits.MAX_STEP).to(state.dtype)
    open_ = wanted.clone()
    furthest = float(longest.max()) if isinstance(longest, Tensor) else longest
    for i in range(math.ceil(furthest / limits.MAX_STEP)):
        after = rk4_step(model.rates, state, step.unsqueeze(-1))
        h_after, falling = model.gap(after, height), model.gap_rate(after) < 0
        forward = step > 0
        crossed = torch.where(forward, (h >= 0) & (h_after < 0), h_after >= 0)
        missed = (h_after < 0) & torch.where(forward, falling, ~falling) | ~h_after.isfinite()
        found = torch.where(open_ & crossed, (i + ~forward) * step, found)
        open_ &= ~(crossed | missed)
        if not bool(open_.any()):
            break
        state = torch.where(open_.unsqueeze(-1), after, state)
        h = model.gap(state, height)
    return found


def _newton_step(model: BallModel, state: Tensor, height: Tensor | float, tau: Tensor) -> Tensor:
    at = fly(model, state, torch.nan_to_num(tau))
    speed = model.gap_rate(at).clamp_max(-limits.MIN_SPEED)
    return -model.gap(at, height) / speed + 0.0 * tau  # keeps NaN


def fly_through(
    model: BallModel, state: Tensor, dt: Tensor, heights: tuple[Tensor | float, ...]
) -> tuple[Tensor, Tensor]:
    """The state after `dt`, with one contact on the way for each height that the caller gives.

    The contacts happen whether or not their times lie inside [0, dt]: a contact a little before or after the
    interval is a smooth continuation, so that an estimator can move through it. Whether it lies inside is for the
    caller to see in the returned times.

    Args: state: (n, 9).  dt: (n,) s.  heights: for each contact, in order, the surface's height in m, scalar or (n,).
    Returns: state after dt (n, 9), contact times since the start (n, len(heights)) s. NaN in rows in which a contact
        never comes; they have no part in any gradient.
    """
    elapsed = torch.zeros_like(dt)
    lost = torch.zeros_like(dt, dtype=torch.bool)
    times = []
    for height in heights:
        tau = contact_time(model, state, height, dt.abs() + limits.BEYOND)
        lost = lost | tau.isnan()
        tau = tau.masked_fill(lost, 0.0)
        state = model.after_bounce(fly(model, state, tau))
        elapsed = elapsed + tau
        times.append(elapsed.masked_fill(lost, torch.nan))
    after = fly(model, state, dt - elapsed)
    if bool(lost.any()):
        after = after.masked_fill(lost.unsqueeze(-1), torch.nan)
    return after, torch.stack(times, dim=-1) if times else dt.new_zeros((*dt.shape, 0))


def fly_through_jacobian(
    model: BallModel, state: Tensor, dt: Tensor, heights: tuple[Tensor | float, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """`fly_through` and its derivative by the state, composed of flight, saltation and impact.

    Args: as for `fly_through`.
    Returns: state after dt (n, 9), contact times (n, k) s, Jacobian (n, 9, 9); detached from any graph.
    """
    state = state.detach()
    jacobian = torch.eye(state.shape[-1], dtype=state.dtype, device=state.device).expand(*state.shape, -1)
    elapsed = torch.zeros_like(dt)
    elapsed_by_state = torch.zeros_like(state).unsqueeze(-2)  # (n, 1, 9)
    times = []
    for height in heights:
        with torch.no_grad():
            tau = contact_time(model, state, height, dt.abs() + limits.BEYOND)
        before, flight = fly_jacobian(model, state, tau)
        jacobian = flight @ jacobian
        rate, upward = _flow_rate(model, state, tau), gap_jacobian(model, before, height)[1]
        speed = (upward * rate).sum(-1).clamp_max(-limits.MIN_SPEED)
        # at the contact the gap is zero: d gap + speed d tau = 0
        tau_by_state = -(upward.unsqueeze(-2) @ jacobian) / speed[..., None, None]
        jacobian = jacobian + rate.unsqueeze(-1) * tau_by_state
        state, impact = batch_jacobian(model.after_bounce, before, outputs=state.shape[-1])
        jacobian = impact @ jacobian
        elapsed = elapsed + tau
        elapsed_by_state = elapsed_by_state + tau_by_state
        times.append(elapsed)
    after, flight = fly_jacobian(model, state, dt - elapsed)
    if not times:
        return after, dt.new_zeros((*dt.shape, 0)), flight
    jacobian = flight @ jacobian - _flow_rate(model, state, dt - elapsed).unsqueeze(-1) * elapsed_by_state
    return after, torch.stack(times, dim=-1), jacobian


def _flow_rate(model: BallModel, state: Tensor, dt: Tensor) -> Tensor:
    """(n, 9) derivative of `fly` by dt: that of the steps as they are taken, the motion's rate up to their error."""
    flown = batch_jacobian(lambda t: fly(model, state, t[..., 0]), dt.unsqueeze(-1), outputs=state.shape[-1])
    return flown[1][..., 0]


def gap_jacobian(model: BallModel, state: Tensor, height: Tensor | float) -> tuple[Tensor, Tensor]:
    """Gaps (n,) m between balls in states (n, 9) and surfaces at heights in m or (n,), and their derivatives (n, 9)."""
    leaf = state.detach().requires_grad_(True)
    with torch.enable_grad():
        gap = model.gap(leaf, height)
        (gradient,) = torch.autograd.grad(gap.sum(), leaf)
    return gap.detach(), gradient
