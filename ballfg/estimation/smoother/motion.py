"""Lists the events of a track as motions from one sample to the next, and makes the dynamics factors of these."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.motion.limits import steps_over_each
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.estimation.sides.monitor import across_hits
from ballfg.factors.batch import Values
from ballfg.factors.dynamics import ContactFactors, DynamicsFactors, FlightFactors, RestFactors, model_width
from ballfg.factors.noise import Kicks, ProcessNoise
from ballfg.state import VELOCITY

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel


@dataclass(frozen=True)
class Motion:
    """The events between two samples.

    Attributes:
        heights: m, the surfaces of contact, in order.
        times: s since the interval's start, of contacts, as known when the factor was made.
        rest: m, the surface of a ball that rests all the time, or None.
        hit: True if something hits the ball at an unknown moment.
        linked: False if the motion is unknown; the next state starts anew.
    """

    heights: tuple[float, ...] = ()
    times: tuple[float, ...] = ()
    rest: float | None = None
    hit: bool = False
    linked: bool = True

    def same(self, other: Motion) -> bool:
        """True if both have the same events, at any times."""
        mine = (self.heights, self.rest, self.hit, self.linked)
        return mine == (other.heights, other.rest, other.hit, other.linked)

    def covariance(self, dt: Array, noise: ProcessNoise) -> Array:
        """(1, 9, 9) process noise over dt (1,) s: flight, each contact's noise, a hit at an unknown time."""
        return noise.flight(dt) + noise.kicks(dt, kicks_of([self], dt))


FLIGHT = Motion()
LEAST_SIDE = 3
"""Samples before and after a hit without which their paths do not show where they meet."""
KICK_PARTS = 64
"""Parts of an interval to which contact times are rounded for the process noise. With finer ones an estimate would
depend on the rounding of a segmentation, which knows the axes of the frame: with these parts it turns with the data."""


def kicks_of(motions: Sequence[Motion], dt: Array) -> Kicks:
    """The contacts and hits of m motions with equal numbers of contacts, over dt (m,) s; times are rounded."""
    times = [
        [round(time / duration * KICK_PARTS) * duration / KICK_PARTS for time in motion.times]
        for motion, duration in zip(motions, dt.tolist(), strict=True)
    ]
    return Kicks(np.array(times), np.array([motion.hit for motion in motions]))


def eventful_motions(segmentation: Segmentation, times: Array) -> dict[int, Motion]:
    """The motion of every interval with an event, in their order, of samples at times (n,) s."""
    count = len(times) - 1
    met = contacts_by_interval(segmentation.contacts)
    rests: dict[int, float] = {}
    for rest in segmentation.rests:
        rests.update(dict.fromkeys(range(max(rest.first, 0), min(rest.last, count - 1) + 1), rest.height))
    hits, restarts = set(segmentation.hits.tolist()), set(segmentation.restarts.tolist())
    return {
        i: Motion(
            heights=tuple(contact.height for contact in met.get(i, ())),
            times=tuple(contact.time - float(times[i]) for contact in met.get(i, ())),
            rest=None if i in met else rests.get(i),
            hit=i in hits,
            linked=i not in restarts,
        )
        for i in sorted(met.keys() | rests.keys() | hits | restarts)
        if 0 <= i < count
    }


def contacts_by_interval(contacts: tuple[Contact, ...]) -> dict[int, list[Contact]]:
    """Contacts of each interval, in time order."""
    found: dict[int, list[Contact]] = {}
    for contact in sorted(contacts, key=lambda c: (c.interval, c.time)):
        found.setdefault(contact.interval, []).append(contact)
    return found


def with_moved_hits(
    found: Segmentation, contacts: Sequence[Contact], times: Array, values: Values, model: BallModel, noise: float
) -> Segmentation:
    """A segmentation, each hit moved by one interval to where the estimated paths before and after it meet.

    A hit stays where too few samples show these paths, at another event, and at a stamp so near that the noise of a
    sample hides on which side of it the hit was: the covariances hold both.

    Args: found: with the hits of `values`.  contacts: refined.  times: (n,) s.  values: estimated.
        noise: m, standard deviation of a sample.
    """
    if not len(found.hits):
        return found
    still = {contact.interval for contact in contacts} | set(found.restarts.tolist())
    taken = still | set(found.hits.tolist())
    for rest in found.rests:
        taken |= set(range(rest.first, rest.last + 1))
    there, lags, _ = across_hits(model, times, values.states, values.coefficients[: model_width(model)], found.hits)
    jumps = np.linalg.norm(there[:, 0, VELOCITY] - values.states[found.hits, VELOCITY], axis=1)
    ways, slack = lags * jumps, np.diff(times)[found.hits] * jumps + noise
    late = (ways > slack).astype(int) - (ways < -noise)
    ends = [-1, *found.hits.tolist(), len(times) - 1]
    hits = [
        hit + step
        if step
        and hit not in still
        and hit + step not in taken
        and before + LEAST_SIDE <= hit + step <= after - LEAST_SIDE
        else hit
        for before, hit, after, step in zip(ends, ends[1:-1], ends[2:], late.tolist(), strict=False)
    ]
    return found if hits == ends[1:-1] else replace(found, hits=np.array(hits, dtype=np.int64))


def move_hits(values: Values, times: Array, old: Index, new: Index, model: BallModel) -> Values:
    """Values for a continued search after hits moved from intervals to neighbours, (h,) each, of samples at (n,) s."""
    if np.array_equal(old, new):
        return values
    states = values.states.copy()
    there, _, _ = across_hits(model, times, states, values.coefficients[: model_width(model)], old)
    for row in np.flatnonzero(new != old):
        late = int(new[row] > old[row])
        states[old[row] + late] = there[row, late]
    return replace(values, states=states)


class TrackDynamics:
    """Makes the dynamics factors of one track at (n,) s; those of free flight once, for all arrangements."""

    def __init__(self, times: Array, model: BallModel, noise: ProcessNoise) -> None:
        self.times, self.model, self.noise = times, model, noise
        self.dt = np.diff(times)
        self._steps = steps_over_each(self.dt)

    @cached_property
    def _flights(self) -> dict[int, FlightFactors]:
        """A flight over every interval, in batches of those with the same number of integration steps."""
        found = {}
        for steps in np.unique(self._steps).tolist():
            rows = np.flatnonzero(self._steps == steps)
            found[steps] = FlightFactors(self.model, rows, self.dt[rows], self.noise.flight_along_one(self.dt[rows]))
        return found

    def factors(self, events: Segmentation) -> list[DynamicsFactors]:
        """One factor per linked interval, in batches that share a motion and a number of integration steps."""
        motions = eventful_motions(events, self.times)
        flying = np.ones(len(self.dt), dtype=bool)
        groups: defaultdict[int, list[int]] = defaultdict(list)  # by the number of contacts; 0 for rests
        for i, motion in motions.items():
            flying[i] = motion.linked and not motion.heights and motion.rest is None
            if motion.linked and not flying[i]:
                groups[len(motion.heights)].append(i)
        hit = np.array([i for i, motion in motions.items() if motion.hit], dtype=np.int64)
        found: list[DynamicsFactors] = [self._flown(steps, flying, hit) for steps in self._flights]
        found += [self._touching(np.array(rows), [motions[i] for i in rows]) for rows in groups.values()]
        return sorted((batch for batch in found if len(batch)), key=lambda batch: int(batch.variables[0, 0]))

    def _flown(self, steps: int, flying: Array, hit: Index) -> FlightFactors:
        """Flights in some of the intervals; for `hit` ones the process noise contains a hit."""
        flights = self._flights[steps]
        intervals = flights.variables[:, 0]
        kept = flying[intervals]
        flights = flights if kept.all() else flights.select(np.flatnonzero(kept))
        struck = np.flatnonzero(np.isin(flights.variables[:, 0], hit))
        return flights.with_hits(struck, self.noise) if len(struck) else flights

    def _touching(self, rows: Index, motions: list[Motion]) -> DynamicsFactors:
        """Contacts in intervals with equal numbers of them, or rests."""
        dt, kicks = self.dt[rows], kicks_of(motions, self.dt[rows])
        covariance = self.noise.flight(dt) + self.noise.kicks(dt, kicks)
        if motions[0].heights:
            heights = np.array([m.heights for m in motions])
            return ContactFactors(self.model, rows, dt, covariance, heights, kicks)
        return RestFactors(self.model, rows, dt, covariance, np.array([m.rest for m in motions]), kicks)
