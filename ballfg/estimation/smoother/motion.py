"""Lists the events of a track interval by interval, as the motion from one sample to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.factors.noise import Kicks, ProcessNoise


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

    def kick_times(self, dt: float) -> tuple[float, ...]:
        """`times` for the process noise over dt s: rounded to `KICK_PARTS`."""
        return tuple(round(time / dt * KICK_PARTS) * dt / KICK_PARTS for time in self.times)

    def covariance(self, dt: Array, noise: ProcessNoise) -> Array:
        """(1, 9, 9) process noise over dt (1,) s: flight, each contact's noise, a hit at an unknown time."""
        return noise.flight(dt) + noise.kicks(dt, kicks_of([self], dt))


FLIGHT = Motion()
KICK_PARTS = 64
"""Parts of an interval to which contact times are rounded for the process noise. With finer ones an estimate would
depend on the rounding of a segmentation, which knows the axes of the frame: with these parts it turns with the data."""


def kicks_of(motions: Sequence[Motion], dt: Array) -> Kicks:
    """The contacts and hits of m motions with equal numbers of contacts, over dt (m,) s."""
    times = [motion.kick_times(duration) for motion, duration in zip(motions, dt.tolist(), strict=True)]
    return Kicks(np.array(times), np.array([motion.hit for motion in motions]))


def motions_of(segmentation: Segmentation, times: Array) -> list[Motion]:
    """The motion of every interval of a track or window.

    Args: segmentation: of n samples.  times: (n,) s.
    """
    found = eventful_motions(segmentation, times)
    return [found.get(i, FLIGHT) for i in range(len(times) - 1)]


def eventful_motions(segmentation: Segmentation, times: Array) -> dict[int, Motion]:
    """The motion of every interval with an event, in their order.

    Args: segmentation: of n samples.  times: (n,) s.
    """
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
