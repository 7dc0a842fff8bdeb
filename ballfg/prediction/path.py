"""Follows a ball ahead: its mean, which has events at certain times, and a sample of possible balls about it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ballfg.arrays import Array, plain
from ballfg.dynamics.compiled.beliefs.course import Scattered, density_of
from ballfg.dynamics.compiled.beliefs.mixture import FAR
from ballfg.dynamics.motion.arrays import is_resting, place_on, surface_offsets
from ballfg.dynamics.motion.limits import LONGEST_MOTION, MAX_STEP, REST_SPEED
from ballfg.dynamics.surfaces import Surfaces
from ballfg.prediction.belief import Belief, normal_points, root_of
from ballfg.prediction.crossing import Crossing, line_crossing, next_contact
from ballfg.prediction.plane import APEX, Line, Plane
from ballfg.prediction.propagate import FlownOnce, Propagator
from ballfg.state import POSITION, STATE_DIM, VELOCITY, VZ, Z

if TYPE_CHECKING:
    from ballfg.factors.noise import ProcessNoise
    from ballfg.prediction.state import BallState

PAIRS: Final = 64  # Least number of pairs of possible balls, opposite about the mean; shares are right to some 0.03
STEP: Final = 0.08  # s, longest step of a possible ball; at 20 m/s its place is right to 0.2 mm after one
SPANS: Final = 8
"""Number of parts of the horizon in which a possible ball has a random acceleration each. A later part is longer: up to
10 s ahead it lasts at most a step longer than the time before it, else balls lie too close together in it."""
LATER: Final = 1.0
"""s beyond the horizon in which a contact is looked for, which other balls than the mean one may have within it."""
Carried: TypeAlias = tuple[Propagator, Belief]


@dataclass(frozen=True)
class Path:
    """The way of a ball ahead: what carries it on from the start, up to a horizon, s."""

    start: BallState
    carried: Carried
    horizon: float

    @cached_property
    def searched(self) -> tuple[FlownOnce, Belief]:
        """As `carried`, for several searches of events."""
        propagator, belief = self.carried
        return FlownOnce(propagator.surfaces, propagator.noise, belief), belief

    @cached_property
    def possible(self) -> Scattered:
        """Paths of possible balls: at starts that the belief holds, with random accelerations, kicks and ends."""
        (propagator, belief), horizon = self.carried, min(self.horizon, LONGEST_MOTION)
        surfaces, pairs = propagator.surfaces, max(PAIRS, belief.mean.shape[1])
        chance = _chance(pairs, horizon, propagator.noise, surfaces.edge_sigmas)
        errors = normal_points(pairs, belief.mean.shape[1]) @ root_of(belief.covariance[0]).T
        start = _placed(belief, errors, surfaces)
        return Scattered.of(belief.model, start, horizon / len(chance[0]), chance, surfaces)

    @cached_property
    def _contacts(self) -> list[Crossing | None]:
        """The mean ball's contacts as far as they have been searched; None after the last one."""
        return []

    def contact(self, after: float = -math.inf) -> Crossing | None:
        """The mean ball's first contact later than a time, s, until `LATER` beyond the horizon; searched once."""
        known = self._contacts
        while not known or (known[-1] is not None and known[-1].time <= after):
            since = known[-1].time if known and known[-1] is not None else -math.inf
            known.append(next_contact(*self.searched, self.horizon + LATER, after=since))
        return next((one for one in known if one is None or one.time > after), None)

    def crossing(self, plane: Plane) -> Crossing | None:
        """The crossing of a plane by the mean ball, with the covariance of all balls about it that have one."""
        return self.event(Line.of(plane))[0]

    def apex(self) -> Crossing | None:
        """The next highest point of the mean ball, with the covariance of all balls about it that have one."""
        return self.event(Line.of(APEX))[0]

    def event(self, line: Line) -> tuple[Crossing | None, bool]:
        """The mean ball's event with the covariance of all balls about it that have one, and whether all are alike.

        Alike, none has it, or all have it and only its time is in doubt. Near a bounce some have it before and others
        after; some have had it just now, and have it again later or in the other direction; by an end of the table some
        meet the table and others do not; some turn before a plane.
        """
        since = -math.inf
        for _ in range(line.after):
            contact = self.contact(since)
            if contact is None:
                return None, False
            since = contact.time
        found = line_crossing(*self.searched, line, self.horizon, since)
        if found is None:
            return None, self._stays_off(line)
        apart = self._apart(found, line)
        if not (apart or self._near_a_bounce(found)):
            return found, True
        alike, events = (False, self._events(line)) if apart else self._soon(found, line)
        times, states, met = events
        if len(met) and (apart or (met != met[0]).any()):
            found = spread_over(found, states, times - (found.time - self.start.time))
        return found, alike

    def _soon(self, found: Crossing, line: Line) -> tuple[bool, tuple[Array, Array, Array]]:
        """`_events` near a bounce, and whether all balls have one soon: they need not be followed any further then."""
        soon = min(self.horizon, found.time - self.start.time + 2.0 * FAR * found.time_sigma)  # which may be infinite
        soon = math.ceil(soon / STEP) * STEP
        if soon < self.horizon and not self._just_now(Line.of(APEX)):  # which needs the whole way anyway
            events = (way := Path(self.start, self.carried, soon))._events(line)
            if len(events[0]) == len(way.possible.states):  # none is much slower than the mean
                return True, events
        return False, self._events(line)

    def _stays_off(self, line: Line) -> bool:
        """Whether all balls stay on the mean's side of a plane, which it does not cross within the horizon."""
        if line.is_apex or self._by_an_end(self.start.time + self.horizon):
            return False
        (propagator, belief), own = self.searched, slice(STATE_DIM)
        ends, means, spreads = propagator.flown.known()
        states = np.concatenate((belief.mean[:, own], means[:, own]))
        about = np.concatenate((belief.covariance[:, own, own], spreads[:, own, own]))
        if np.diff(np.abs(ends), prepend=0.0, append=self.horizon).max() > 2.0 * MAX_STEP:
            return False
        met = np.flatnonzero(ends < 0.0)  # in these steps some balls have bounced and others not
        late = np.sqrt(about[met, Z, Z]) / np.maximum(np.abs(states[met, VZ]), np.finfo(float).tiny)
        doubt = late @ np.abs((states[met + 1] - states[met])[:, VELOCITY] @ line.normal[POSITION])
        values = line.value(states)
        spread = FAR * (np.sqrt(np.maximum(line.normal @ about @ line.normal, 0.0)) + doubt)
        return bool((values > spread).all() or (values < -spread).all())

    def _apart(self, found: Crossing, line: Line) -> bool:
        """Whether some balls may have another event than the mean, or none, even if they bounce as often before."""
        until = found.time + FAR * found.time_sigma
        return self._just_now(line) or may_turn(line, found) or self._by_an_end(until)

    def _just_now(self, line: Line) -> bool:
        """Whether some balls may be on the other side of an event than the mean at the start."""
        belief, own = self.carried[1], slice(STATE_DIM)  # without the other side of a contact
        variance = float(line.normal @ belief.covariance[0, own, own] @ line.normal)
        return bool(abs(line.value(self.start.state)) < FAR * math.sqrt(max(variance, 0.0)))

    def _near_a_bounce(self, found: Crossing) -> bool:
        """Whether some balls may have bounced at an event, and others not."""
        about, since = FAR * found.time_sigma, -math.inf
        while (contact := self.contact(since)) is not None:
            reach = about + FAR * contact.time_sigma
            if abs(contact.time - found.time) <= reach:
                return True
            if contact.time > found.time:
                return False
            since = contact.time
        return False

    def _by_an_end(self, until: float) -> bool:
        """Whether by a time (s) some balls may meet the table where the mean falls past it, or the reverse."""
        since = -np.inf if self.carried[0].surfaces.extent is not None else np.inf
        while since < until:
            contact = self.contact(since)
            if may_pass_an_end(self, contact, since, until):
                return True
            since = np.inf if contact is None else contact.time
        return False

    def _events(self, line: Line) -> tuple[Array, Array, Array]:
        """Times (m,) s since the start, states (m, 9) and numbers of bounces (m,) of the balls that have an event."""
        balls, above = self.possible, line.value(self.possible.states) > 0.0
        crossed = (above[:, :-1] != above[:, 1:]) & (balls.met[:, :-1] >= line.after)
        if line.direction != "either":
            crossed &= above[:, :-1] == (line.direction == "down")
        rows = np.flatnonzero(crossed.any(axis=1))
        at = crossed[rows].argmax(axis=1)
        plane = line.normal[POSITION], line.offset
        times, states = balls.topped(rows, at) if line.is_apex else balls.crossed(rows, at, *plane)
        return times, states, balls.met[rows, at]

    def probability(self, line: Line) -> float:
        """Share of balls whose line . state goes through the offset in a direction, after a number of bounces."""
        balls = self.possible
        value, rate = line.value(balls.states), balls.states[..., VELOCITY] @ line.normal[POSITION]
        before, later = rate[:, :-1], rate[:, 1:]
        turns = before * later < 0.0  # the highest or lowest point between two moments, of a parabola
        turn = np.where(turns, 0.5 * before**2 * np.diff(balls.times) / np.where(turns, before - later, 1.0), 0.0)
        values = np.empty((len(value), 2 * value.shape[1] - 1))
        values[:, ::2], values[:, 1::2] = value, value[:, :-1] + turn
        counts = np.repeat(balls.met >= line.after, 2, axis=1)[:, :-1]
        first, then = (values > 0.0) & counts, (values < 0.0) & counts
        if line.direction == "either":
            return float((first.any(axis=1) & then.any(axis=1)).mean())
        first, then = (then, first) if line.direction == "up" else (first, then)
        return float((np.maximum.accumulate(first, axis=1) & then).any(axis=1).mean())


def may_turn(line: Line, found: Crossing) -> bool:
    """Whether some balls may not be fast enough to cross where the mean does; all balls fall at an apex."""
    normal = line.normal[POSITION]
    variance = float(normal @ found.covariance[VELOCITY, VELOCITY] @ normal)
    return abs(float(normal @ found.state[VELOCITY])) <= FAR * math.sqrt(max(variance, 0.0)) and not line.is_apex


def may_pass_an_end(path: Path, found: Crossing | None, since: float = -math.inf, until: float = math.inf) -> bool:
    """Whether some balls may come down on the table and others past its ends, before a time (s).

    Args: found: the mean's first contact after a time `since`, s.
    """
    propagator, belief = path.carried
    surfaces, (extent, top) = propagator.surfaces, (propagator.surfaces.extent, propagator.surfaces.table_height)
    if extent is None or not path.start.state[Z] > top:
        return False
    if found is None or not found.state[Z] > top:  # where the mean falls past the table, if it does
        level = top + belief.model.radius
        lid = Line.of(Plane((0.0, 0.0, 1.0), level, "down"))
        found = line_crossing(*path.searched, lid, path.horizon + LATER, since)
    if found is None:
        return True
    near = FAR * np.hypot(np.sqrt(np.diagonal(found.covariance)[:2]).repeat(2), surfaces.edge_sigmas)
    sooner = found.time - FAR * found.time_sigma < until
    return sooner and bool((np.abs(found.state[:2].repeat(2) - extent) < near).any())


def spread_over(found: Crossing, states: Array, late: Array) -> Crossing:
    """The mean's event with the covariance of possible balls about it: states (m, 9), late (m,) s after the mean."""
    off = states - found.state
    return replace(found, time_sigma=math.sqrt(float((late**2).mean())), covariance=off.T @ off / len(off))


def _placed(belief: Belief, errors: Array, surfaces: Surfaces) -> Array:
    """States and coefficients (n, 9 + p) at some errors; if the mean lies on a surface, so do all."""
    mean, model = belief.mean, belief.model
    start = mean + errors
    if abs(float(mean[0, VZ])) <= REST_SPEED:
        level = surfaces.level_below(mean, surface_offsets(model, mean))
        if is_resting(model, mean, level)[0]:
            start = place_on(model, start, float(level[0]))
    return belief.within_bounds(start)


@lru_cache(maxsize=64)
def _chance(
    pairs: int, horizon: float, process: ProcessNoise, edge_sigmas: tuple[float, float, float, float]
) -> tuple[Array, Array, Array]:
    """What happens to possible balls by chance: pushes, kicks and ends, as `Scattered.of` takes them."""
    noise = density_of(process)
    steps = max(math.ceil(horizon / STEP - 1e-9), 1)
    ends = np.maximum(np.geomspace(1, steps, min(SPANS, steps)).round(), 1.0 + np.arange(min(SPANS, steps)))
    spans = np.searchsorted(ends, np.arange(steps), side="right")  # of lasting pushes, by step
    h, lasting = horizon / steps, np.bincount(spans)
    kicks, sides, pushed = np.split(normal_points(pairs, 7 + 3 * SPANS, seed=1), [3, 7], axis=1)
    pushes = pushed.reshape(2 * pairs, SPANS, 3)[:, : len(lasting)] * (noise[0] / np.sqrt(h * lasting))[:, None]
    off = sides * edge_sigmas if any(edge_sigmas) else np.zeros_like(sides)
    return plain(pushes[:, spans].swapaxes(0, 1)), kicks * noise[[3, 3, 2]], off
