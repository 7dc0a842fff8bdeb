"""Finds pictures that repeat the one before, as conversions of frame rates make them, and leaves them out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.progress import Watch, unwatched
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.motion import Frames

SMALLER: Final = 0.25
"""Of a picture that is compared."""
BLOCK: Final = 4
"""Of its pixels, whose mean is compared: compression changes single ones."""
SAME, SHARE = 3.0, 0.2
"""Grey levels, and share of the median, below which the largest change of a block is that of compression alone: it is
1.6 at most in a real video written again with doubled pictures, where the least real change is 35."""
UNEVEN: Final = 1
"""Pictures by which the distances of doubled ones differ, where they come from a conversion of the frame rate."""


@dataclass(frozen=True, eq=False)
class Kept:
    """The pictures of a video that do not repeat the one before.

    Attributes:
        frames: opens the video without the others.  numbers: (f,) of the kept pictures in the video.
        stamps: (n,) s, of all pictures, as the video has them.
    """

    frames: Frames
    numbers: Index
    stamps: Array

    @property
    def doubled(self) -> int:
        """Number of the others."""
        return len(self.stamps) - len(self.numbers)

    def places(self, pictures: Index) -> Index:
        """(p,) places among the kept ones of pictures (p,) of the video; -1 for the others."""
        after = np.clip(np.searchsorted(self.numbers, pictures), 0, len(self.numbers) - 1)
        return np.where(self.numbers[after] == pictures, after, -1)


def without_doubled(frames: Frames, count: int, watch: Watch = unwatched) -> Kept:
    """The pictures of a video without doubled ones, with even stamps if these come at even distances.

    Args: frames: opens the video.  count: of its pictures, about.
    """
    times, changes, last = list[float](), list[float](), None
    for stamp, image in watch(frames(), count, "pictures compared with the one before"):
        small = cv2.resize(image, None, fx=SMALLER, fy=SMALLER, interpolation=cv2.INTER_AREA)
        small = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.float32)
        if last is not None:
            change = np.abs(small - last)
            size = (max(change.shape[1] // BLOCK, 1), max(change.shape[0] // BLOCK, 1))
            changes.append(float(cv2.resize(change, size, interpolation=cv2.INTER_AREA).max()))
        times.append(stamp)
        last = small
    least = min(SAME, SHARE * float(np.median(changes))) if changes else 0.0
    repeats: Mask = np.append(False, np.array(changes) < least)
    numbers = np.flatnonzero(~repeats)
    if len(numbers) == len(times):
        return Kept(frames, numbers, np.array(times))
    stamps = _even(np.array(times), repeats)[numbers]

    def kept() -> Iterator[tuple[float, Image]]:
        place = iter(stamps.tolist())
        for again, (_, image) in zip(repeats.tolist(), frames(), strict=True):
            if not again:
                yield next(place), image

    return Kept(kept, numbers, np.array(times))


def _even(times: Array, repeats: Mask) -> Array:
    """(f,) s, stamps of all pictures: those between doubled ones were taken evenly, if these come at even distances."""
    apart = np.diff(np.flatnonzero(repeats))
    if len(apart) < 2 or np.ptp(apart) > UNEVEN:
        return times
    passed = np.cumsum(~repeats) - 1.0
    kept = np.flatnonzero(~repeats)
    rate = (times[kept[-1]] - times[kept[0]]) / max(passed[-1], 1.0)
    return np.asarray(times[kept[0]] + rate * passed)
