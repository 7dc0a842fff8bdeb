"""A segmentation holds the contacts, hits, rests and sample qualities of a track."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

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

    def only_contacts(self) -> Segmentation:
        """The same contacts and rests, without hits and with every sample good: for undisturbed tracks."""
        none = np.zeros(0, dtype=np.int64)
        return Segmentation(self.contacts, none, none, self.rests, np.zeros_like(self.quality))

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(n,) True for samples that measure the ball: good or wide ones."""
        return self.quality <= Quality.WIDE
