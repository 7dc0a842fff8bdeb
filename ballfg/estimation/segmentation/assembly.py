"""Assembles a segmentation from a chain of events."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ballfg.estimation.segmentation.events import Event, EventKind
from ballfg.estimation.segmentation.result import Contact, Quality, Rest

BREAKS = (EventKind.HIT, EventKind.RESTART)
"""Events after which nothing is known of the past."""


def contacts_of(events: Sequence[Event]) -> list[Contact]:
    """The contacts, in order."""
    return [Contact(e.index, e.time, e.height) for e in events if e.kind is EventKind.CONTACT and e.height is not None]


def intervals_of(events: Sequence[Event], *kinds: EventKind) -> list[int]:
    """The intervals with an event of some kinds, ascending."""
    return sorted({e.index for e in events if e.kind in kinds})


def rests_of(events: Sequence[Event], samples: int) -> list[Rest]:
    """The rests: from the first whole interval on a surface to the last.

    A rest begins in the interval of its event and is whole from the next one on; a ball leaves at the end of its
    interval, but a hit may fall anywhere inside.
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
    jumps = np.zeros((samples, 3))
    shifts = [event for event in events if event.kind is EventKind.SHIFT]
    contacts = intervals_of(events, EventKind.CONTACT) if shifts else []
    for event in shifts:
        jumps[event.index + 1] += event.offset
    marked = np.zeros(samples, dtype=bool)
    cuts = [0, *(i + 1 for i in intervals_of(events, *BREAKS)), samples]
    for first, stop in pairwise(cuts):
        inside = [event.index for event in shifts if first <= event.index + 1 < stop]
        if not inside or (len(inside) == 1 and inside[0] in contacts):
            continue
        offsets = np.cumsum(jumps[first:stop], axis=0)
        offsets -= np.median(offsets, axis=0)
        marked[first:stop] = np.linalg.norm(offsets, axis=1) > level
    return marked
