"""Rolls many balls out to many times, arc by arc: the same motion as `rollout`, in far fewer steps.

`rollout` steps from stamp to stamp. Here the balls fly in common steps of `MAX_STEP`, each from its own last contact
on; the states at the stamps come from a Hermite polynomial through the ends of the step in which they lie, with the
position's second derivatives, so that nothing of the integration's accuracy is lost (docs/derivations/integration.md).
A contact is solved once an arc, for all balls together. `rollout` takes over all balls that do more than fly and bounce
(rest, roll, lie below a surface).
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ballfg.dynamics.model import BallModel, take_rows
from ballfg.dynamics.motion.contact import contact_time
from ballfg.dynamics.motion.flight_step import derivative, rk4_step
from ballfg.dynamics.motion.integrate import fly, fly_jacobian
from ballfg.dynamics.motion.limits import LONGEST_MOTION, MAX_STEP, REST_SPEED
from ballfg.dynamics.motion.rollout import next_surface, rollout, stays
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import POSITION, VELOCITY, VZ

MOST_ARCS = 40  # Number of arcs after which a ball is about to come to rest


def paths(model: BallModel, state: Tensor, times: Tensor, surfaces: Surfaces) -> Tensor:
    """The states at a sequence of times.

    Args: state: (n, 9) at time 0.  times: (k,) or (n, k) s since then, not decreasing, not negative.
    Returns: (n, k, 9), differentiable once in the states and the parameters, through the contact times too.
    Raises: ValueError: if the times are negative or decrease.
    """
    times = times.expand(state.shape[0], -1) if times.dim() == 1 else times
    if times.shape[1] == 0 or not bool((torch.diff(times, dim=-1, prepend=torch.zeros_like(times[:, :1])) >= 0).all()):
        return rollout(model, state, times, surfaces)  # `rollout` raises the error
    result = state.unsqueeze(1).expand(-1, times.shape[1], -1)
    strange = times[:, -1] > LONGEST_MOTION
    active, begun, at = torch.arange(len(state)), torch.zeros_like(times[:, 0]), state
    for _ in range(MOST_ARCS):
        own, asked = take_rows(model, active, len(times)), times[active]
        arc = _fly_arc(own, at, asked[:, -1] - begun.detach(), surfaces)
        bounced, tau, ends_here = _land(own, arc, at)
        end = torch.where(arc.landed, (begun + tau).detach(), torch.inf)
        inside = (asked >= begun.detach().unsqueeze(1)) & (asked <= end.unsqueeze(1))
        sampled = arc.sample((asked - begun.unsqueeze(1)).clamp_min(0.0))
        result = result.index_put((active,), torch.where(inside.unsqueeze(-1), sampled, result[active]))
        strange = strange.index_put((active,), strange[active] | ends_here | arc.resting)
        onward = arc.landed & ~ends_here & (end < asked[:, -1])
        at, begun, active = bounced[onward], (begun + tau)[onward], active[onward]
        if len(active) == 0:
            break
    strange = strange.index_put((active,), torch.ones_like(active, dtype=torch.bool))
    if bool(strange.any()):
        rows = strange.nonzero()[:, 0]
        part = rollout(take_rows(model, rows, len(times)), state[rows], times[rows], surfaces)
        result = result.index_put((rows,), part)
    return result


@dataclass(frozen=True)
class _Arc:
    """Free flight of m balls from a common moment on."""

    nodes: Tensor  # (j + 1, m, 9) states, `MAX_STEP` apart; a ball that has landed stays where it was
    slopes: Tensor  # (j + 1, m, 9) their derivatives by time
    landed: Tensor  # (m,) bool, the ball came down on a surface
    step: Tensor  # (m,) the step in which it did
    height: Tensor  # (m,) m, of that surface
    resting: Tensor  # (m,) bool, the ball lay on a surface from the start

    def sample(self, times: Tensor) -> Tensor:
        """(m, k, 9) states at times (m, k) s since the start of the arc."""
        place = times / MAX_STEP
        step = place.detach().floor().clamp(0, len(self.nodes) - 2).long()
        theta = (place - step).unsqueeze(-1)
        index = step.unsqueeze(-1).expand(-1, -1, self.nodes.shape[-1])
        nodes, slopes = self.nodes.transpose(0, 1), self.slopes.transpose(0, 1)
        ends = [values.gather(1, end) for end in (index, index + 1) for values in (nodes, slopes)]
        return hermite(theta, MAX_STEP, *ends)


def hermite(theta: Tensor, h: Tensor | float, x0: Tensor, d0: Tensor, x1: Tensor, d1: Tensor) -> Tensor:
    """(..., 9) states within a step: position of degree five, velocity its derivative, everything else of degree three.

    Args:
        theta: (..., 1) in [0, 1].  h: s, the step, scalar or (..., 1).
        x0, d0: (..., 9) state and derivative at the step's start.  x1, d1: at its end.
    """
    t2, t3 = theta * theta, theta * theta * theta
    t4, t5 = t3 * theta, t3 * t2
    p0, v0, a0 = x0[..., POSITION], d0[..., POSITION], d0[..., VELOCITY]
    p1, v1, a1 = x1[..., POSITION], d1[..., POSITION], d1[..., VELOCITY]
    rise = 10 * t3 - 15 * t4 + 6 * t5
    position = (
        p0 + rise * (p1 - p0) + h * (theta - 6 * t3 + 8 * t4 - 3 * t5) * v0 + h * (-4 * t3 + 7 * t4 - 3 * t5) * v1
    )
    position = position + h * h * (0.5 * (t2 - 3 * t3 + 3 * t4 - t5) * a0 + 0.5 * (t3 - 2 * t4 + t5) * a1)
    velocity = (30 * t2 - 60 * t3 + 30 * t4) * (p1 - p0) / h
    velocity = velocity + (1 - 18 * t2 + 32 * t3 - 15 * t4) * v0 + (-12 * t2 + 28 * t3 - 15 * t4) * v1
    velocity = velocity + h * (
        0.5 * (2 * theta - 9 * t2 + 12 * t3 - 5 * t4) * a0 + 0.5 * (3 * t2 - 8 * t3 + 5 * t4) * a1
    )
    r0, r1, s0, s1 = (x[..., VELOCITY.stop :] for x in (x0, x1, d0, d1))
    rest = r0 + (3 * t2 - 2 * t3) * (r1 - r0) + h * ((theta - 2 * t2 + t3) * s0 + (t3 - t2) * s1)
    return torch.cat((position, velocity, rest), dim=-1)


def _fly_arc(model: BallModel, state: Tensor, left: Tensor, surfaces: Surfaces) -> _Arc:
    """Flight of balls (m, 9) until each has landed or flown for `left` (m,) s."""
    first = state.detach()
    resting = stays(model, first, surfaces.level_below(first, model.surface_offset(first)), surfaces)
    done = resting.clone()
    landed, step, level = torch.zeros_like(done), torch.zeros_like(done, dtype=torch.long), torch.zeros_like(left)
    start, nodes, still = state, [first], list[Tensor]()
    with torch.no_grad():
        while not still or not bool(done.all()):
            state = nodes[-1]
            after = fly(model, state, torch.full_like(left, MAX_STEP))
            height = surfaces.level_below(state, model.surface_offset(state))
            height, landing = next_surface(model, state, after, height, ~done, surfaces)
            step = torch.where(landing, len(nodes) - 1, step)
            level, landed = torch.where(landing, height, level), landed | landing
            nodes.append(torch.where(done.unsqueeze(-1), state, after))
            still.append(done)
            done = done | landing | ((len(nodes) - 1) * MAX_STEP >= left)
    joined = torch.stack(nodes)
    if torch.is_grad_enabled():
        joined = _followed(model, start, joined, torch.stack(still))
    return _Arc(joined, derivative(model.rates, joined), landed, step, level, resting)


def _followed(model: BallModel, start: Tensor, nodes: Tensor, stays_put: Tensor) -> Tensor:
    """Known nodes (j + 1, m, 9), differentiable once in the first of them, `start`, and in the parameters.

    Args: stays_put: (j, m) bool, the ball has landed and does not take the step.
    """
    before, dt = nodes[:-1], nodes.new_full(nodes[:-1].shape[:-1], MAX_STEP)
    after = torch.where(stays_put.unsqueeze(-1), before, rk4_step(model.rates, before, dt.unsqueeze(-1)))
    _, jacobians = fly_jacobian(model, before, dt)
    still = torch.eye(nodes.shape[-1], dtype=nodes.dtype, device=nodes.device)
    followed: Tensor = _Chain.apply(start, after, torch.where(stays_put[..., None, None], still, jacobians))
    return followed


class _Chain(torch.autograd.Function):
    """Known states x_k = F_k(x_{k-1}), with the Jacobians A_k of all steps.

    Autograd through a loop evaluates the model step by step, forward and back. Here what the parameters do in each step
    is one batch, `after`, and a gradient by the states goes back through the Jacobians: u_{k-1} += A_k^T u_k.
    """

    @staticmethod
    def forward(ctx: Any, start: Tensor, after: Tensor, jacobians: Tensor) -> Tensor:
        ctx.save_for_backward(jacobians)
        return torch.cat((start.unsqueeze(0), after))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, Tensor, None]:
        (jacobians,) = ctx.saved_tensors
        pulled = list(upstream[0].unbind())
        for k in range(len(jacobians), 0, -1):
            pulled[k - 1] = pulled[k - 1] + (pulled[k].unsqueeze(-2) @ jacobians[k - 1]).squeeze(-2)
        return pulled[0], torch.stack(pulled[1:]), None


def _land(model: BallModel, arc: _Arc, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """States (m, 9) just after the contacts, times (m,) s since the arc's start, whether (m,) the ball stays there."""
    tau, bounced = arc.nodes.new_zeros(len(start)), start
    ends_here = torch.zeros_like(arc.landed)
    if not bool(arc.landed.any()):
        return bounced, tau, ends_here
    rows = arc.landed.nonzero()[:, 0]
    own = take_rows(model, rows, len(start))
    before = arc.nodes[arc.step[rows], rows]
    within = contact_time(own, before, arc.height[rows])
    lost = within.isnan()
    within = within.masked_fill(lost, 0.0)
    after = own.after_bounce(fly(own, before, within))
    stops = lost | (after[:, VZ].detach() < REST_SPEED)
    return (
        bounced.index_put((rows,), after),
        tau.index_put((rows,), arc.step[rows].to(within.dtype) * MAX_STEP + within),
        ends_here.index_put((rows,), stops),
    )
