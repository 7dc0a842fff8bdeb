"""Where and when: the apex, the next contact, the crossing of a plane - each with the covariance of place and time.

An event is a function g of the state that changes sign. At the crossing time the state's covariance is projected onto
g = 0: a ball that is late is further back but crosses at the same place (docs/derivations/prediction.md).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.optimize import brentq, root_scalar
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.contact import contact_time
from ballfg.dynamics.motion.integrate import MAX_STEP, RateFunction, batch_jacobian, derivative, fly
from ballfg.dynamics.motion.rollout import advance, is_resting
from ballfg.dynamics.surfaces import Surfaces
from ballfg.prediction.belief import Belief
from ballfg.prediction.propagate import Propagator
from ballfg.state import POSITION, STATE_DIM, VZ

EventFunction = Callable[[Tensor], Tensor]
"""(..., d) states to (..., 1) values; the event is where the value falls through zero."""

LOOKS = 16
"""How often a step of `MAX_STEP` is looked at: two crossings within 1.25 ms may pass unseen."""
TIME_TOLERANCE = 1e-12
"""s. A crossing is bracketed to this."""
MARGIN = 0.01
"""Share of a look's width to each side of it in which the exact crossing is looked for too."""
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
        covariance: (9, 9) of the state at the event, at the event's own uncertain time.
    """

    time: float
    time_sigma: float
    state: Array
    covariance: Array

    def __repr__(self) -> str:
        x, y, z = self.state[POSITION].tolist()
        spread = ", ".join(f"{1e3 * s:.3g}" for s in np.sqrt(np.diagonal(self.covariance))[POSITION])
        return (
            f"Crossing(t = {self.time:.4f} s +- {1e3 * self.time_sigma:.3g} ms, at ({x:.3f}, {y:.3f}, {z:.3f}) m "
            f"+- ({spread}) mm)"
        )


def apex(propagator: Propagator, belief: Belief, horizon: float = 3.0, *, after: float = -math.inf) -> Crossing | None:
    """The next highest point, where the ball turns from up to down.

    Args: as for `next_crossing`; for the apex that follows the next contact give that one's time as `after`.
    Returns: None if there is none within the horizon. A resting ball has none.
    Raises: ValueError: as `next_crossing`.
    """
    return next_crossing(propagator, belief, _vertical_speed, horizon, after=after)


def next_contact(
    propagator: Propagator, belief: Belief, horizon: float = 3.0, *, after: float = -math.inf
) -> Crossing | None:
    """The state just before the next contact with a surface.

    Args: as for `next_crossing`; for the second contact give the first one's time as `after`.
    Returns: None if there is none within the horizon. A ball that rests or rolls has none until it falls.
    Raises: ValueError: as `next_crossing`.
    """
    start, end = _span(belief, horizon)
    model, earliest = belief.model, max(start, after) + JUST_NOW
    while (left := end - float(belief.time)) > 0.0:
        if flown := propagator.flights(belief, _steps(left, MAX_STEP)):
            belief = flown[-1]
            continue
        h = torch.tensor([min(left, MAX_STEP)], dtype=torch.float64)
        found = _contact_within(model, belief.mean, h, propagator.surfaces)
        if found is not None:
            tau, height = found
            there = propagator.in_flight(belief, tau)
            if float(there.time) > earliest:
                return _projected(there, partial(_gap, model, height), model.rates)
            h = tau + JUST_NOW  # a small hop may be over within the step
        belief = propagator.forward(belief, h)
    return None


def plane_crossing(
    propagator: Propagator,
    belief: Belief,
    normal: ArrayLike | Tensor,
    offset: float,
    horizon: float = 3.0,
    *,
    after: float = -math.inf,
) -> Crossing | None:
    """Where the ball's centre goes through the plane normal . p = offset, from either side.

    Args:
        propagator, belief, horizon, after: as for `next_crossing`.
        normal: (3,) dimensionless, of the plane, of any length but zero.
        offset: m, in units of the normal's length.
    Returns: None if the ball does not get there within the horizon. A ball that starts on the plane has crossed it.
    Raises: ValueError: a normal that is zero or not three finite numbers, or as `next_crossing`.
    """
    direction = torch.as_tensor(normal, dtype=torch.float64)
    if direction.shape != (3,) or not bool(direction.isfinite().all()) or not bool(direction.any()):
        raise ValueError(f"normal must be three finite numbers, not all zero; got {direction.tolist()}")
    if not math.isfinite(offset):
        raise ValueError(f"offset must be finite; got {offset:g}")
    length = float(direction.square().sum().sqrt())

    def distance(state: Tensor) -> Tensor:
        return ((state[..., POSITION] * direction).sum(-1, keepdim=True) - offset) / length

    return next_crossing(propagator, belief, distance, horizon, after=after, either_way=True)


def _gap(model: BallModel, height: float, state: Tensor) -> Tensor:
    return model.gap(state, height).unsqueeze(-1)


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
    """The first time at which an event's value falls through zero, after any number of bounces.

    Args:
        propagator: surfaces and noise.  belief: one ball.
        event: see `EventFunction`; continuous in the state. A jump through zero in a bounce is no crossing.
        horizon: s from the belief's time.
        after: s on the ball's clock; only later events count. An event at the belief's own time is past.
        either_way: take a rise through zero as well.
    Returns: None if there is no crossing within the horizon.
    Raises: ValueError: if the belief does not hold exactly one ball, or the horizon is not a positive number of s.
    """
    start, end = _span(belief, horizon)
    earliest = max(start, after) + JUST_NOW
    while (left := end - float(belief.time)) > 0.0:
        if flown := propagator.flights(belief, _steps(left, MAX_STEP - JUST_NOW)):
            found = _crossing_in_flight(propagator, [belief, *flown], event, earliest, either_way)
            if found is not None:
                return found
            belief = flown[-1]
            continue
        h = torch.tensor([min(left, MAX_STEP - JUST_NOW)], dtype=torch.float64)
        for tau in _crossings(propagator, belief, event, h + JUST_NOW, either_way):  # no gap between steps
            if float(belief.time) + tau > earliest:
                there = propagator.forward(belief, torch.tensor([tau], dtype=torch.float64))
                return _projected(there, event, _rates(propagator, there))
        belief = propagator.forward(belief, h)
    return None


def _steps(left: float, longest: float) -> Tensor:
    """(1, k) s, steps of at most `longest` that fill what is left of a search."""
    count = math.ceil(left / longest)
    return torch.full((1, count), longest, dtype=torch.float64).clamp_max(left - longest * torch.arange(count))


def _crossing_in_flight(
    propagator: Propagator, beliefs: Sequence[Belief], event: EventFunction, earliest: float, either_way: bool
) -> Crossing | None:
    """The first crossing after the time `earliest` (s) in the free flight between some beliefs of one ball.

    Looks are at cubics through states and slopes, which are right to a micrometre; the crossing is exact.
    """
    model, times = beliefs[0].model, torch.cat([belief.time for belief in beliefs])
    states, h = torch.cat([belief.mean for belief in beliefs]), times.diff()
    with torch.no_grad():
        values = event(_cubics(states, derivative(model.rates, states), h))[..., 0]  # (k, LOOKS + 1)
    falls = (values[:, :-1] > 0) & (values[:, 1:] <= 0)
    rises = (values[:, :-1] < 0) & (values[:, 1:] >= 0)
    for step, look in (falls | rises if either_way else falls).nonzero().tolist():
        width, belief = float(h[step]) / LOOKS, beliefs[step]
        tau = _exact_time(belief, event, (look - MARGIN) * width, (look + 1 + MARGIN) * width)
        if tau is not None and float(belief.time) + tau > earliest:
            there = propagator.in_flight(belief, torch.tensor([tau], dtype=torch.float64))
            return _projected(there, event, model.rates)
    return None


def _cubics(states: Tensor, slopes: Tensor, h: Tensor) -> Tensor:
    """(k, LOOKS + 1, d) between k + 1 states (k + 1, d) with their slopes, h (k,) s apart."""
    at = torch.linspace(0.0, 1.0, LOOKS + 1, dtype=torch.float64)[:, None]
    low, high, step = states[:-1, None], states[1:, None], h[:, None, None]
    bent = (1 - at) * (slopes[:-1, None] * step - (high - low)) - at * (slopes[1:, None] * step - (high - low))
    return low + at * (high - low) + at * (1 - at) * bent


def _exact_time(belief: Belief, event: EventFunction, low: float, high: float) -> float | None:
    """Time (s from the belief's) between two others at which one ball's value is zero; None: the same sign at both."""

    def value(tau: float) -> float:
        return float(event(fly(belief.model, belief.mean, torch.tensor([tau], dtype=torch.float64))))

    with torch.no_grad():
        found = root_scalar(value, method="secant", x0=low, x1=high, xtol=TIME_TOLERANCE)
        if found.converged and low <= found.root <= high:
            return float(found.root)
        if value(low) * value(high) > 0.0:
            return None
        return float(brentq(value, low, high, xtol=TIME_TOLERANCE))


def _span(belief: Belief, horizon: float) -> tuple[float, float]:
    """Start and end (s) of a search; the arguments are checked."""
    if len(belief) != 1:
        raise ValueError(f"belief must hold one ball; got {len(belief)}. Take them one by one.")
    if not 0.0 < horizon < math.inf:
        raise ValueError(f"horizon must be a positive, finite number of seconds; got {horizon:g}")
    start = float(belief.time)
    return start, start + horizon


def _contact_within(model: BallModel, mean: Tensor, h: Tensor, surfaces: Surfaces) -> tuple[Tensor, float] | None:
    """Time (1,) s until a falling ball meets a surface in a step, and that surface's height; None if it does not."""
    with torch.no_grad():
        after = fly(model, mean, h)
        for height in surfaces.heights():
            falls = float(model.gap(after, height)) < 0.0 and float(after[0, VZ]) < 0.0
            if not falls or bool(is_resting(model, mean, height)):
                continue
            tau = contact_time(model, mean, height)
            if float(tau) >= -JUST_NOW and _lies_under(surfaces, fly(model, mean, tau), height):
                return tau.clamp_min(0.0), height
    return None


def _lies_under(surfaces: Surfaces, state: Tensor, height: float) -> bool:
    return height != surfaces.table_height or bool(surfaces.over_table(state))


def _crossings(
    propagator: Propagator, belief: Belief, event: EventFunction, h: Tensor, either_way: bool
) -> Iterator[float]:
    """Times (s from the belief's) at which the value goes through zero within a step h (1,)."""
    looks = torch.linspace(0.0, 1.0, LOOKS + 1, dtype=torch.float64)

    def changes(low: Tensor, high: Tensor) -> Iterator[tuple[Tensor, Tensor, float]]:
        """Brackets of the sign changes between two times, and the value's size at the end of each."""
        times = low + (high - low) * looks
        values = event(_mean_at(belief, times, propagator.surfaces))[:, 0]
        falls = (values[:-1] > 0) & (values[1:] <= 0)
        rises = (values[:-1] < 0) & (values[1:] >= 0)
        for i in (falls | rises if either_way else falls).nonzero()[:, 0].tolist():
            yield times[i], times[i + 1], float(values[i + 1].abs())

    for low, high, size in changes(torch.zeros_like(h), h):
        while float(high - low) > TIME_TOLERANCE:
            low, high, size = next(changes(low, high))
        if size < VALUE_JUMP:
            yield float(high)


def _mean_at(belief: Belief, times: Tensor, surfaces: Surfaces) -> Tensor:
    """(k, d) means of one ball at times (k,) s from the belief's, all within one step."""
    with torch.no_grad():
        later = advance(belief.model, belief.mean.expand(len(times), -1), times, surfaces)
        return torch.where((times > 0.0).unsqueeze(-1), later, belief.mean)  # a ball at a contact has not bounced yet


def _rates(propagator: Propagator, belief: Belief) -> RateFunction:
    """What moves the ball: the air and its weight, or where it rests, friction."""
    level = propagator.surfaces.level_below(belief.mean)
    with torch.no_grad():
        resting = bool(is_resting(belief.model, belief.mean, level))
    resting = resting and _lies_under(propagator.surfaces, belief.mean, float(level))
    return belief.model.roll if resting else belief.model.rates


def _projected(there: Belief, event: EventFunction, rates: RateFunction) -> Crossing:
    """The crossing whose mean is `there`, with the covariance projected along the motion onto the event's surface.

    Where the motion only touches the surface, nothing fixes the time: its sigma is infinite, the covariance that
    at the mean time.
    """
    mean, covariance = there.mean, there.covariance[0]
    _, gradient = batch_jacobian(event, mean, outputs=1)
    with torch.no_grad():
        rate = derivative(rates, mean)  # (1, d)
    closing = (gradient[:, 0] * rate).sum()
    time_sigma = math.inf
    if float(closing) != 0.0:
        time_by_state = -gradient[0] / closing  # (1, d)
        projection = torch.eye(mean.shape[-1], dtype=mean.dtype) + rate.T @ time_by_state
        time_sigma = math.sqrt(max(float(time_by_state @ covariance @ time_by_state.T), 0.0))
        covariance = projection @ covariance @ projection.T
        covariance = (covariance + covariance.T) / 2
    state = mean[0, :STATE_DIM].detach().numpy().copy()
    return Crossing(float(there.time), time_sigma, state, covariance[:STATE_DIM, :STATE_DIM].detach().numpy().copy())
