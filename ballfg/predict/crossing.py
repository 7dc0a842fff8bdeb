"""Where and when: the apex, the next contact, the crossing of a plane - each with the covariance of place and time.

An event is a function g of the state that changes sign. At the crossing time the state's covariance is projected onto
g = 0: a ball that is late is further back but crosses at the same place (docs/derivations/prediction.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ballfg.dynamics.integrate import MAX_STEP, batch_jacobian, derivative, fly
from ballfg.predict.belief import Belief
from ballfg.predict.propagate import Propagator
from ballfg.state import POSITION, STATE_DIM, VZ

EventFunction = Callable[[Tensor], Tensor]
"""(..., d) states to (..., 1) values; the event is where the value falls through zero."""

NEWTON_STEPS = 20
TIME_TOLERANCE = 1e-12  # s
SMALLEST_STEP = 1e-5  # s, of the search for a crossing right after a bounce


@dataclass(frozen=True)
class Crossing:
    """One event of one ball.

    Attributes:
        time: s, on the ball's clock.  time_sigma: s.
        state: (9,) at the event.
        covariance: (9, 9) of the state at the event, whenever it happens.
    """

    time: float
    time_sigma: float
    state: Tensor
    covariance: Tensor


def apex(propagator: Propagator, belief: Belief, horizon: float = 3.0) -> Crossing | None:
    """The next highest point; None if there is none within `horizon` s. `belief` holds one ball."""
    return next_crossing(propagator, belief, _vertical_speed, horizon)


def next_contact(propagator: Propagator, belief: Belief, horizon: float = 3.0) -> Crossing | None:
    """The state just before the next contact with a surface; None if there is none within `horizon` s."""
    height = propagator.surfaces.height_below(belief.mean)

    def gap(state: Tensor) -> Tensor:
        return belief.model.gap(state, height).unsqueeze(-1)

    return next_crossing(propagator, belief, gap, horizon)


def plane_crossing(
    propagator: Propagator, belief: Belief, normal: Tensor, offset: float, horizon: float = 3.0
) -> Crossing | None:
    """Where the ball's centre goes through the plane normal . p = offset, from either side.

    Args:
        propagator: surfaces and noise.  belief: one ball.
        normal: (3,) of the plane.  offset: m, in units of the normal's length.
        horizon: s.
    """
    side = torch.sign((belief.mean[0, POSITION] * normal).sum() - offset)

    def distance(state: Tensor) -> Tensor:
        return side * ((state[..., POSITION] * normal).sum(-1, keepdim=True) - offset)

    return next_crossing(propagator, belief, distance, horizon)


def _vertical_speed(state: Tensor) -> Tensor:
    return state[..., VZ : VZ + 1]


def next_crossing(
    propagator: Propagator, belief: Belief, event: EventFunction, horizon: float, step: float = MAX_STEP / 2
) -> Crossing | None:
    """The first time at which an event's value falls through zero.

    Args:
        propagator: surfaces and noise.  belief: one ball.
        event: see `EventFunction`.
        horizon: s.  step: s between looks; two crossings within one step are not seen.
    Raises: ValueError: if the belief does not hold exactly one ball.
    """
    if len(belief) != 1:
        raise ValueError(f"belief must hold one ball; got {len(belief)}. Take them one by one.")
    start, h = float(belief.time), torch.tensor([step], dtype=torch.float64)
    while float(belief.time) - start < horizon:
        later = propagator.forward(belief, h)
        flown = fly(belief.model, belief.mean, h)
        if float(event(belief.mean)) > 0.0 and min(float(event(flown)), float(event(later.mean))) <= 0.0:
            found = _at_zero(propagator, belief, event, h)
            if found is not None:
                return found
            if float(h) > SMALLEST_STEP:  # a bounce lies between here and the crossing: go up to it
                h = h / 4
                continue
        belief, h = later, torch.tensor([step], dtype=torch.float64)
    return None


def _at_zero(propagator: Propagator, belief: Belief, event: EventFunction, h: Tensor) -> Crossing | None:
    """Refine a crossing that lies within h of free flight, and project the covariance onto it.

    None if the ball, in free flight, would not get there within h, or would have to go through a surface.
    """
    tau = h / 2
    for _ in range(NEWTON_STEPS):
        state = fly(belief.model, belief.mean, tau).detach()
        value, gradient = batch_jacobian(event, state)
        rate = (gradient[:, 0] * derivative(belief.model.rates, state).detach()).sum(-1)
        move = -value[:, 0] / rate
        tau = (tau + move).clamp(torch.zeros_like(h), h)
        if float(move.abs()) < TIME_TOLERANCE:
            break
    there = propagator.in_flight(belief, tau)
    missed = abs(float(event(there.mean))) > 1e-9
    height = propagator.surfaces.height_below(belief.mean)
    if missed or float(belief.model.gap(there.mean, height)) < -1e-9:
        return None
    _, gradient = batch_jacobian(event, there.mean)
    rate = derivative(belief.model.rates, there.mean).detach()
    closing = (gradient[:, 0] * rate).sum(-1)
    time_by_state = -gradient[0] / closing  # (1, d)
    projection = torch.eye(there.mean.shape[-1], dtype=torch.float64) + rate.T @ time_by_state
    covariance = projection @ there.covariance[0] @ projection.T
    variance = time_by_state @ there.covariance[0] @ time_by_state.T
    return Crossing(
        float(there.time), float(variance.sqrt()), there.mean[0, :STATE_DIM], covariance[:STATE_DIM, :STATE_DIM]
    )
