"""Where and when: the apex, the next contact, the crossing of a plane - each with the covariance of place and time.

An event is a function g of the state that changes sign. At the crossing time the state's covariance is projected onto
g = 0: a ball that is late is further back but crosses at the same place (docs/derivations/prediction.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ballfg.dynamics.contact import contact_time
from ballfg.dynamics.integrate import MAX_STEP, batch_jacobian, derivative, fly
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.rollout import advance, is_resting
from ballfg.dynamics.surfaces import Surfaces
from ballfg.predict.belief import Belief
from ballfg.predict.propagate import Propagator
from ballfg.state import POSITION, STATE_DIM, VELOCITY, VZ

EventFunction = Callable[[Tensor], Tensor]
"""(..., d) states to (..., 1) values; the event is where the value falls through zero."""

LOOKS = 16
"""How often a step of `MAX_STEP` is looked at: two crossings within 1.25 ms may pass unseen."""
TIME_TOLERANCE = 1e-12
"""s. A crossing is bracketed to this."""
VALUE_JUMP = 1e-6
"""Value, in the event's own unit, beyond which it jumped through zero in a bounce and did not cross it."""
JUST_NOW = 1e-9
"""s. An event no later than this after the time from which events count is not a new one."""


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


def apex(propagator: Propagator, belief: Belief, horizon: float = 3.0, *, after: float = -math.inf) -> Crossing | None:
    """The next highest point, where the ball turns from up to down.

    Args: as for `next_crossing`; for the apex that follows the next contact give that one's time as `after`.
    Returns: None if there is none within the horizon. A resting ball has none.
    """
    return next_crossing(propagator, belief, _vertical_speed, horizon, after=after)


def next_contact(
    propagator: Propagator, belief: Belief, horizon: float = 3.0, *, after: float = -math.inf
) -> Crossing | None:
    """The state just before the next contact with a surface.

    Args: as for `next_crossing`; for the second contact give the first one's time as `after`.
    Returns: None if there is none within the horizon. A ball that rests or rolls has none until it falls.
    """
    start, end = _span(belief, horizon)
    model, earliest = belief.model, max(start, after) + JUST_NOW
    while (left := end - float(belief.time)) > 0.0:
        h = torch.tensor([min(left, MAX_STEP)], dtype=torch.float64)
        found = _contact_within(model, belief.mean, h, propagator.surfaces)
        if found is not None:
            tau, height = found
            there = propagator.in_flight(belief, tau)
            if float(there.time) > earliest:
                return _projected(there, lambda state: model.gap(state, height).unsqueeze(-1), model.rates)
        belief = propagator.forward(belief, h)
    return None


def plane_crossing(
    propagator: Propagator,
    belief: Belief,
    normal: Tensor,
    offset: float,
    horizon: float = 3.0,
    *,
    after: float = -math.inf,
) -> Crossing | None:
    """Where the ball's centre goes through the plane normal . p = offset, from either side.

    Args:
        propagator, belief, horizon, after: as for `next_crossing`.
        normal: (3,) of the plane, of any length but zero.
        offset: m, in units of the normal's length.
    Returns: None if the ball does not get there within the horizon. A ball that starts on the plane has crossed it.
    Raises: ValueError: for another normal or offset.
    """
    normal = torch.as_tensor(normal, dtype=torch.float64)
    if normal.shape != (3,) or not bool(normal.isfinite().all()) or not bool(normal.any()):
        raise ValueError(f"normal must be three finite numbers, not all zero; got {normal.tolist()}")
    if not math.isfinite(offset):
        raise ValueError(f"offset must be finite; got {offset:g}")
    length = float(normal.square().sum().sqrt())

    def distance(state: Tensor) -> Tensor:
        return ((state[..., POSITION] * normal).sum(-1, keepdim=True) - offset) / length

    return next_crossing(propagator, belief, distance, horizon, after=after, either_way=True)


def _vertical_speed(state: Tensor) -> Tensor:
    return state[..., VZ : VZ + 1]


def next_crossing(
    propagator: Propagator,
    belief: Belief,
    event: EventFunction,
    horizon: float,
    *,
    after: float = -math.inf,
    either_way: bool = False,
) -> Crossing | None:
    """The first time at which an event's value falls through zero, after however many bounces.

    Args:
        propagator: surfaces and noise.  belief: one ball.
        event: see `EventFunction`; continuous in the state. Where a bounce makes it jump through zero is no crossing.
        horizon: s from the belief's time.
        after: s on the ball's clock; only later events count. An event at the belief's own time is past.
        either_way: take a rise through zero as well.
    Returns: None if there is no crossing within the horizon.
    Raises: ValueError: if the belief does not hold exactly one ball, or the horizon is not a positive number of s.
    """
    start, end = _span(belief, horizon)
    earliest = max(start, after) + JUST_NOW
    while (left := end - float(belief.time)) > 0.0:
        h = torch.tensor([min(left, MAX_STEP)], dtype=torch.float64)
        for tau in _crossings(propagator, belief, event, h, either_way):
            if float(belief.time) + tau > earliest:
                there = propagator.forward(belief, torch.tensor([tau], dtype=torch.float64))
                return _projected(there, event, _rates(propagator, there))
        belief = propagator.forward(belief, h)
    return None


def _span(belief: Belief, horizon: float) -> tuple[float, float]:
    """Start and end (s) of a search; the arguments are checked."""
    if len(belief) != 1:
        raise ValueError(f"belief must hold one ball; got {len(belief)}. Take them one by one.")
    if not 0.0 < horizon < math.inf:
        raise ValueError(f"horizon must be a positive, finite number of seconds; got {horizon:g}")
    start = float(belief.time)
    return start, start + horizon


def _contact_within(
    model: BallModel, mean: Tensor, h: Tensor, surfaces: Surfaces
) -> tuple[Tensor, float] | None:
    """Time (1,) s until a falling ball meets a surface in a step, and that surface's height; None if it does not."""
    with torch.no_grad():
        after = fly(model, mean, h)
        for height in surfaces.heights():
            falls = float(model.gap(after, height)) < 0.0 and float(after[0, VZ]) < 0.0
            if not falls or bool(is_resting(model, mean, height)):
                continue
            tau = contact_time(model, mean, height)
            if float(tau) >= 0.0 and _under(surfaces, fly(model, mean, tau), height):
                return tau, height
    return None
