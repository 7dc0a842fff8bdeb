"""Assembles the segmentation of a track from the events of a chain."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index, plain
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNTS, NOTHING, ONE, REAL, TWO
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Contact, Event, EventKind, Quality, Rest, Segmentation
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.state import Z

BREAKS = (EventKind.HIT, EventKind.RESTART)
"""Events after which nothing is known of the past."""


def intervals_of(events: Sequence[Event], *kinds: EventKind) -> list[int]:
    """The intervals with an event of some kinds, ascending."""
    return sorted({e.index for e in events if e.kind in kinds})


def rests_of(events: Sequence[Event], samples: int) -> list[Rest]:
    """The rests: from the first whole interval on a surface to the last.

    A rest begins in the interval of its event; a ball leaves at an interval's end, but a hit falls anywhere inside.
    """
    rests = []
    start: Event | None = None
    for event in [*events, None]:
        if event is not None and event.kind not in (*BREAKS, EventKind.REST, EventKind.LEAVE):
            continue
        if start is not None and start.height is not None:
            end = samples - 1 if event is None else event.index + (event.kind is EventKind.LEAVE)
            if end > start.index + 1:
                rests.append(Rest(start.index + 1, end - 1, start.height))
        start = event if event is not None and event.kind is EventKind.REST else None
    return rests


def quality_of(events: Sequence[Event], samples: int, shift_level: float) -> NDArray[np.int8]:
    """(samples,) quality; a shift counts more than a wide noise, and less than an outlier."""
    quality = np.full(samples, Quality.GOOD, dtype=np.int8)
    quality[intervals_of(events, EventKind.WIDE)] = Quality.WIDE
    quality[shifted(events, samples, shift_level)] = Quality.SHIFTED
    quality[intervals_of(events, EventKind.OUTLIER)] = Quality.OUTLIER
    return quality


def shifted(events: Sequence[Event], samples: int, level: float) -> NDArray[np.bool_]:
    """(samples,) True if a sample's offset differs by more than `level` m from the most common one of its segment.

    A segment does not show which of two offsets is the true one; the tracker is assumed to be right most of the time. A
    lone shift in the interval of a contact is left out: the jump belongs to the contact as well.
    """
    jumps, marked = np.zeros((samples, 3)), np.zeros(samples, dtype=bool)
    shifts = [event for event in events if event.kind is EventKind.SHIFT]
    contacts = intervals_of(events, EventKind.CONTACT)
    for event in shifts:
        jumps[event.index + 1] += event.offset
    for first, stop in pairwise([0, *(i + 1 for i in intervals_of(events, *BREAKS)), samples]):
        inside = [event.index for event in shifts if first <= event.index + 1 < stop]
        if not inside or (len(inside) == 1 and inside[0] in contacts):
            continue
        offsets = np.cumsum(jumps[first:stop], axis=0)
        offsets -= np.median(offsets, axis=0)
        marked[first:stop] = np.linalg.norm(offsets, axis=1) > level
    return marked


SIDE = 8
"""Number of samples on each side: at 180 Hz and 1.5 mm they give the velocity to 0.1 m/s."""
LEAST_SIDE = 4
"""Least number of samples on each side for a decision."""
LONGEST_INTERVAL = 0.02
"""s. Over longer intervals, drag and the unknown moment of the touch blur the jump."""
LEEWAY = 0.3
"""m/s, of tangential jump that noise and the Magnus force over these samples may feign."""


def hits_at_contacts(
    times: Array,
    positions: Array,
    usable: NDArray[np.bool_],
    contacts: Sequence[Contact],
    hits: Sequence[int],
    physics: SegmentationPhysics,
    settings: SegmentationSettings,
) -> list[int]:
    """Intervals of contacts with a tangential jump beyond Coulomb friction: mu (1 + e) v_n.

    The forward pass takes a bat, a net or a frame at a contact for one whose unknown friction costs less than a hit.

    Args:
        times: (n,) s.  positions: (n, 3) m.  usable: (n,) samples that measure the ball.
        contacts: in order.  hits: intervals; they bound the used samples, as neighbouring contacts do.
    """
    ends = sorted({-1, len(times) - 1, *hits, *(contact.interval for contact in contacts)})
    found = []
    for contact in contacts:
        i = contact.interval
        if i in hits or not 0 <= i < len(times) - 1 or times[i + 1] - times[i] > LONGEST_INTERVAL:
            continue
        place = ends.index(i)
        stop = min(ends[place + 1], i + SIDE) if place + 1 < len(ends) else i
        sides = (max(ends[place - 1] + 1, i + 1 - SIDE), i), (i + 1, stop)
        before, after = (_velocity(times, positions, usable, *side, contact.time, physics) for side in sides)
        if before is None or after is None:
            continue
        jump = np.hypot(*(after[:2] - before[:2]))
        if jump > settings.friction_excess * physics.friction * (1.0 + physics.restitution) * abs(before[2]) + LEEWAY:
            found.append(i)
    return found


def _velocity(
    times: Array,
    positions: Array,
    usable: NDArray[np.bool_],
    first: int,
    last: int,
    at: float,
    physics: SegmentationPhysics,
) -> Array | None:
    """(3,) m/s at time `at`: least squares of flight under gravity and drag through the usable samples first..last."""
    rows = first + np.flatnonzero(usable[first : last + 1])
    if len(rows) < LEAST_SIDE:
        return None
    velocity = np.empty(3)
    _fit_velocity(plain(times), plain(positions), rows, at, physics.drag, physics.gravity, velocity)
    return velocity


@machine_code(NOTHING(ONE, TWO, COUNTS, REAL, REAL, REAL, ONE))
def _fit_velocity(
    times: Array, positions: Array, rows: Index, at: float, drag: float, gravity: float, velocity: Array
) -> None:
    """Writes the velocity (3,) of `_velocity` through the samples `rows` (m,). Args: drag: 1/m.  gravity: m/s^2."""
    first, last, m = rows[0], rows[-1], len(rows)
    speed, mean, scatter = 0.0, 0.0, 0.0
    for axis in range(3):
        velocity[axis] = (positions[last, axis] - positions[first, axis]) / (times[last] - times[first])
        speed += velocity[axis] ** 2
    for row in rows:
        mean += (times[row] - at) / m
    for row in rows:
        scatter += (times[row] - at - mean) ** 2
    for axis in range(3):
        pull = -drag * math.sqrt(speed) * velocity[axis] - (gravity if axis == Z else 0.0)
        moved = 0.0
        for row in rows:  # less the first position: a difference of large numbers would be rounded
            since = times[row] - at
            moved += (since - mean) * (positions[row, axis] - positions[first, axis] - 0.5 * pull * since**2)
        velocity[axis] = moved / scatter


def assembled(
    events: Sequence[Event], times: Array, positions: Array, ball: SegmentationPhysics, settings: SegmentationSettings
) -> Segmentation:
    """The segmentation by a chain of events, with hits at contacts.

    Args: times: (n,) s.  positions: (n, 3) m.  ball: of the track.  settings: of the forward pass.
    Source: docs/derivations/segmentation.md.
    """
    n = len(times)
    met = (e for e in events if e.kind is EventKind.CONTACT)
    contacts = [Contact(e.index, e.time, e.height) for e in met if e.height is not None]
    hits, quality = intervals_of(events, *BREAKS), quality_of(events, n, settings.shift_level)
    hits += hits_at_contacts(times, ball.level(positions), quality <= Quality.WIDE, contacts, hits, ball, settings)
    restarts = np.array(intervals_of(events, EventKind.RESTART), dtype=np.int64)
    hit = np.array(sorted(hits), dtype=np.int64)
    return Segmentation(tuple(contacts), hit, restarts, tuple(rests_of(events, n)), quality)
