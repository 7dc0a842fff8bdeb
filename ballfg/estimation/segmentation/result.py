"""Kinds of events; a segmentation holds the contacts, hits, rests and qualities of a track."""

from dataclasses import dataclass
from enum import Enum, IntEnum, auto

import numpy as np
from numpy.typing import NDArray


class Quality(IntEnum):
    """Quality of a sample."""

    GOOD = 0
    """Fits within its stated noise."""
    WIDE = 1
    """Fits with a noise some times larger than stated."""
    SHIFTED = 2
    """Has an offset in common with its neighbours: the tracker followed something else for a while."""
    OUTLIER = 3
    """Carries no information on the ball."""


@dataclass(frozen=True)
class Contact:
    """The ball meets a surface and leaves it, or comes to rest on it.

    Attributes:
        interval: i, the contact lies between samples i and i + 1 (by a fraction of an interval it may lie outside).
        time: s, on the track's clock.
        height: m, declared height of the surface met, table or floor.
    """

    interval: int
    time: float
    height: float


@dataclass(frozen=True)
class Rest:
    """The ball lies or rolls on a surface during whole intervals.

    Attributes:
        first: first such interval; the ball is down at sample `first`.
        last: last such interval, inclusive; the ball is still down at sample `last` + 1.
        height: m, declared height of the surface.
    """

    first: int
    last: int
    height: float


@dataclass(frozen=True, eq=False)
class Segmentation:
    """The best explanation of a track of n samples; interval i lies between samples i and i + 1."""

    contacts: tuple[Contact, ...]
    """In the order of time."""

    hits: NDArray[np.int64]
    """(h,) intervals in which something other than a surface changed the velocity, ascending. A hit and a contact may
    share an interval: the ball touched both."""

    restarts: NDArray[np.int64]
    """(r,) those of the hits in gaps so long that nothing links the two sides."""

    rests: tuple[Rest, ...]
    """In the order of time; they do not overlap."""

    quality: NDArray[np.int8]
    """(n,) values of `Quality`."""

    @property
    def segments(self) -> list[tuple[int, int]]:
        """First and last sample, inclusive, of each stretch without a hit; one stretch if there is none."""
        if len(self.quality) == 0:
            return []
        ends = [*self.hits.tolist(), len(self.quality) - 1]
        starts = [0, *(self.hits + 1).tolist()]
        return list(zip(starts, ends, strict=True))

    @classmethod
    def of_contacts(cls, contacts: tuple[Contact, ...], samples: int) -> "Segmentation":
        """Contacts alone, of so many good samples."""
        none = np.zeros(0, dtype=np.int64)
        return cls(contacts, none, none, (), np.full(samples, Quality.GOOD, dtype=np.int8))

    def opening(self, samples: int) -> "Segmentation":
        """The contacts between the first samples, so many, all of them good."""
        return Segmentation.of_contacts(tuple(one for one in self.contacts if one.interval < samples - 1), samples)

    def only_contacts(self) -> "Segmentation":
        """The same contacts and rests, without hits and with every sample good: for undisturbed tracks."""
        none = np.zeros(0, dtype=np.int64)
        return Segmentation(self.contacts, none, none, self.rests, np.zeros_like(self.quality))

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(n,) True for samples that measure the ball: good or wide ones."""
        return self.quality <= Quality.WIDE


class EventKind(Enum):
    """Kinds of events in an interval or at a sample."""

    CONTACT = auto()
    """Between two samples: the ball meets a surface."""
    HIT = auto()
    """Between two samples: the velocity is forgotten."""
    RESTART = auto()
    """Between two samples: a gap too long to bridge; everything is forgotten."""
    SHIFT = auto()
    """Between two samples: the measurements jump, the velocity stays."""
    REST = auto()
    """Between two samples: the ball stays down on a surface."""
    LEAVE = auto()
    """Between two samples: a resting ball gets into the air, for instance over an edge."""
    WIDE = auto()
    """At a sample: its noise is larger than stated."""
    OUTLIER = auto()
    """At a sample: it carries no information on the ball."""


CONTACT, HIT, RESTART, SHIFT, REST, LEAVE, WIDE, OUTLIER = (kind.value for kind in EventKind)
"""The values of `EventKind`, for machine code."""


@dataclass(frozen=True, eq=False)
class Event:
    """One event of an explanation.

    Attributes:
        kind: what happened.  index: the interval of the event (-1: before the first sample), or the sample.
        time: s, on the track's clock: of a contact itself; for other events the stamp of the first sample after it.
        height: m, declared height of the surface, if any.  offset: (3,) m, jump of the measurements, for a shift.
    """

    kind: EventKind
    index: int
    time: float
    height: float | None = None
    offset: NDArray[np.float64] | None = None
