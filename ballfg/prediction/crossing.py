"""Finds the time and place of an apex, a contact or the crossing of a plane, with their covariance.

An event is a function g of the state that changes sign. At the crossing time the state's covariance is projected onto
g = 0: a ball that is late is further back but crosses at the same place (docs/derivations/prediction.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array
from ballfg.checks import check_array, check_number
from ballfg.dynamics.compiled.beliefs.course import Found
from ballfg.dynamics.compiled.beliefs.events import FOUND, LOOKS, NONE, TIME_TOLERANCE
from ballfg.dynamics.motion import arrays
from ballfg.dynamics.motion.limits import MAX_STEP
from ballfg.dynamics.surfaces import Surfaces
from ballfg.prediction.belief import Belief
from ballfg.prediction.plane import APEX, Line, Plane
from ballfg.prediction.propagate import Propagator
from ballfg.state import POSITION, STATE_DIM, VZ

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.model import BallModel

EventFunction = Callable[["Tensor"], "Tensor"]
"""(..., d) states to (..., 1) values, in torch; the event is where the value falls through zero."""
SearchStep = Callable[[Belief, float, float], tuple["Crossing | None", Belief]]
"""From a belief, the end of a search and the time (s) from which events count to an event and the belief then."""

Search = Callable[..., Found]
"""As `Propagator.search`, of a belief, a horizon and the time from which events count."""
VALUE_JUMP = 1e-6  # Largest value, in the event's own unit, of a crossing; a larger one jumped through zero in a bounce
JUST_NOW = 1e-9  # s. Least delay of a new event after the time from which events count


class _Event(NamedTuple):
    """An event on arrays: states (k, d) to its values (k,), and to their gradients (k, d)."""

    values: Callable[[Array], Array]
    gradients: Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Crossing:
    """One event of one ball.

    Attributes:
        time: s, on the ball's clock.  time_sigma: s.  state: (9,) at the event.
        covariance: (9, 9) of the state at the event, at the event's own uncertain time.
    """

    time: float
    time_sigma: float
    state: Array
    covariance: Array

    def later(self, seconds: float) -> Crossing:
        """The same event on a clock that is ahead by some seconds."""
        return replace(self, time=self.time + seconds)

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
    return line_crossing(propagator, belief, Line.of(APEX), horizon, after)


def next_contact(
    propagator: Propagator, belief: Belief, horizon: float = 3.0, *, after: float = -math.inf
) -> Crossing | None:
    """The state right before the next contact with a surface.

    Args: as for `next_crossing`; for the second contact give the first one's time as `after`.
    Returns: None if there is none within the horizon. A ball that rests or rolls has none until it falls.
    Raises: ValueError: as `next_crossing`.
    """
    return _first(belief, horizon, after, partial(_contact_step, propagator), propagator.search)


def plane_crossing(
    propagator: Propagator,
    belief: Belief,
    normal: ArrayLike,
    offset: float,
    horizon: float = 3.0,
    *,
    after: float = -math.inf,
    direction: str = "either",
) -> Crossing | None:
    """The crossing of the plane normal . p = offset by the ball's centre.

    Args:
        propagator, belief, horizon, after: as for `next_crossing`.
        normal: (3,) dimensionless, of the plane, of any length but zero.
        offset: m, in units of the normal's length.
        direction: `up` along the normal, `down` against it, or `either`.
    Returns: None if the ball does not get there within the horizon. A ball that starts on the plane has crossed it.
    Raises: ValueError: a normal that is zero or not three finite numbers, an unknown direction, or as `next_crossing`.
    """
    given = tuple(check_array("normal", normal).ravel().tolist())
    return line_crossing(propagator, belief, Line.of(Plane(given, offset, direction)), horizon, after)  # type: ignore[arg-type]


def line_crossing(propagator: Propagator, belief: Belief, line: Line, horizon: float, after: float) -> Crossing | None:
    """The next time at which a ball goes through a line's offset; args as for `next_crossing`."""
    normal, offset = line.falling

    def step(belief: Belief, end: float, earliest: float) -> tuple[Crossing | None, Belief]:
        gradient = np.concatenate((normal, np.zeros(belief.mean.shape[1] - STATE_DIM)))
        event = _Event(lambda s: s @ gradient - offset, lambda s: np.tile(gradient, (len(s), 1)))
        return _crossing_step(propagator, event, line.either_way, belief, end, earliest)

    search = partial(propagator.search, line=(normal, offset), either_way=line.either_way)
    return _first(belief, horizon, after, step, search)


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
        either_way: count a rise through zero as well.
    Returns: None if there is no crossing within the horizon.
    Raises: ValueError: if the belief does not hold exactly one ball, or the horizon is not a positive number of s.
    """
    return _first(belief, horizon, after, partial(_crossing_step, propagator, _in_torch(event), either_way))


def _in_torch(event: EventFunction) -> _Event:
    """An event that torch computes."""
    import torch

    from ballfg.dynamics.motion.integrate import batch_jacobian

    def values(states: Array) -> Array:
        with torch.no_grad():
            return np.asarray(event(torch.from_numpy(states))[:, 0].numpy())

    def gradients(states: Array) -> Array:
        return np.asarray(batch_jacobian(event, torch.from_numpy(states), outputs=1)[1][:, 0].numpy())

    return _Event(values, gradients)


def _first(
    belief: Belief, horizon: float, after: float, step: SearchStep, search: Search | None = None
) -> Crossing | None:
    """The first event: found by machine code, `search`, where there is any; by a `step` at a time where that ends."""
    if len(belief) != 1:
        raise ValueError(f"belief must hold one ball; got {len(belief)}. Take them one by one.")
    end, start = check_number("horizon", horizon, "s", above=0.0), float(belief.time[0])
    earliest = max(after - start, 0.0) + JUST_NOW + float(np.spacing(abs(start)))  # as `after` was rounded
    now = 0.0
    while now < end:
        if search is not None:
            found = search(belief, end - now, earliest - now)
            now += found.elapsed
            if found.how == FOUND:
                return _projected(start + now, found.mean, found.covariance, found.gradient, found.rate)
            if found.how == NONE:
                return None
            belief = Belief(belief.model, np.array([now]), found.mean[None], found.covariance[None])
        elif now == 0.0:
            belief = belief.from_zero()
        crossing, belief = step(belief, end, earliest)
        if crossing is not None:
            return crossing.later(start)
        now = float(belief.time[0])
    return None


def _contact_step(
    propagator: Propagator, belief: Belief, end: float, earliest: float
) -> tuple[Crossing | None, Belief]:
    """A contact within one step, and the belief after the step, or after a contact that came too early to count."""
    model, h = belief.model, min(end - float(belief.time[0]), MAX_STEP)
    found = _contact_within(model, belief.mean, h, propagator.surfaces)
    if found is not None:
        tau, height = found
        there = propagator.in_flight(belief, np.array([tau]))
        if float(there.time[0]) > earliest:
            return _at_event(there, arrays.gap_jacobian(model, there.mean, height)[1][0], rolls=False), there
        h = tau + JUST_NOW  # a small hop may be over within the step
    return None, propagator.forward(belief, np.array([h]))


def _crossing_step(
    propagator: Propagator, event: _Event, either_way: bool, belief: Belief, end: float, earliest: float
) -> tuple[Crossing | None, Belief]:
    """A crossing within one step, and the belief after the step."""
    start = float(belief.time[0])
    h = min(end - start, MAX_STEP - JUST_NOW)
    for tau in _crossings(propagator, belief, event, h + JUST_NOW, either_way):  # no gap between steps
        if start + tau > earliest:
            there = propagator.forward(belief, np.array([tau]))
            return _at_event(there, event.gradients(there.mean)[0], rolls=_rolls(propagator, there)), there
    return None, propagator.forward(belief, np.array([h]))


def _contact_within(model: BallModel, mean: Array, h: float, surfaces: Surfaces) -> tuple[float, float] | None:
    """Time (s) until a falling ball (1, d) meets a surface in a step, and that surface's height; None without one."""
    after = arrays.fly(model, mean, np.array([h]))
    for height in surfaces.heights():
        falls = arrays.gaps(model, after, height)[0] < 0.0 and after[0, VZ] < 0.0
        if not falls or arrays.is_resting(model, mean, height)[0]:
            continue
        tau = arrays.contact_times(model, mean, height)
        if tau[0] >= -JUST_NOW and _lies_under(surfaces, arrays.fly(model, mean, tau), height):
            return max(float(tau[0]), 0.0), height
    return None


def _lies_under(surfaces: Surfaces, state: Array, height: float) -> bool:
    return height != surfaces.table_height or bool(surfaces.over_table(state)[0])


def _crossings(propagator: Propagator, belief: Belief, event: _Event, h: float, either_way: bool) -> Iterator[float]:
    """Times (s from the belief's) at which the value goes through zero within a step of h s."""
    looks = np.linspace(0.0, 1.0, LOOKS + 1)

    def changes(low: float, high: float) -> Iterator[tuple[float, float, float]]:
        """Brackets of the sign changes between two times, and the value's size at the end of each."""
        times = low + (high - low) * looks
        values = event.values(_mean_at(belief, times, propagator.surfaces))
        falls = (values[:-1] > 0) & (values[1:] <= 0)
        rises = (values[:-1] < 0) & (values[1:] >= 0)
        for i in np.flatnonzero(falls | rises if either_way else falls).tolist():
            yield float(times[i]), float(times[i + 1]), abs(float(values[i + 1]))

    for low, high, size in changes(0.0, h):
        while high - low > TIME_TOLERANCE:
            low, high, size = next(changes(low, high))
        if size < VALUE_JUMP:
            yield high


def _mean_at(belief: Belief, times: Array, surfaces: Surfaces) -> Array:
    """(k, d) means of one ball at times (k,) s from the belief's, all within one step."""
    starts = belief.mean.repeat(len(times), axis=0)
    later = arrays.roll_out(belief.model, starts, times[:, None], surfaces)[:, 0]
    return np.where(times[:, None] > 0.0, later, starts)  # a ball at a contact has not bounced yet


def _rolls(propagator: Propagator, belief: Belief) -> bool:
    """Whether friction changes the state, of a ball at rest; else air and weight do."""
    model, mean, surfaces = belief.model, belief.mean, propagator.surfaces
    level = surfaces.level_below(mean, arrays.surface_offsets(model, mean))
    return bool(arrays.is_resting(model, mean, level)[0]) and _lies_under(surfaces, mean, float(level[0]))


def _at_event(there: Belief, gradient: Array, *, rolls: bool) -> Crossing:
    rate = arrays.motion_rates(there.model, there.mean, rolls=rolls)[0]
    return _projected(float(there.time[0]), there.mean[0], there.covariance[0], gradient, rate)


def _projected(time: float, mean: Array, covariance: Array, gradient: Array, rate: Array) -> Crossing:
    """The crossing of a belief, with the covariance projected along the motion onto the event's surface.

    If the motion only touches the surface, the time is undetermined: its sigma is infinite, and the covariance is that
    at the mean time.

    Args: time: s.  mean (d,), covariance (d, d): then.  gradient: (d,) of the event.  rate: (d,) of the state.
    """
    closing, time_sigma = gradient @ rate, math.inf
    spread = covariance[:STATE_DIM, :STATE_DIM].copy()
    if closing != 0.0:
        time_by_state = -gradient / closing
        projection = np.eye(STATE_DIM, len(rate)) + rate[:STATE_DIM, None] * time_by_state
        time_sigma = math.sqrt(max(float(time_by_state @ covariance @ time_by_state), 0.0))
        spread = projection @ covariance @ projection.T
        spread = (spread + spread.T) / 2
    return Crossing(time, time_sigma, mean[:STATE_DIM].copy(), spread)
