"""Stamps of several cameras: which is nearest, and whether the cameras share a shutter."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ballfg.vision.arrays import Array


def nearest(stamps: Array, times: Array) -> NDArray[np.intp]:
    """(k,) for each time the number of the nearest of n >= 1 ascending stamps; the earlier of two equally near."""
    after = np.clip(np.searchsorted(stamps, times), 1, max(len(stamps) - 1, 1))
    after = np.minimum(after, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(times - stamps[before] <= stamps[after] - times, before, after)


def shared_stamps(frames: Sequence[Array], within: float) -> Array | None:
    """The stamps that cameras share, if they do: those of all of them, each once.

    They share a shutter if most frames of the camera with fewer frames, of every two, lie within `within` s of one of
    the other's. Frames may be missing anywhere, and one camera may take every second frame only.

    Args: frames: (f,) s of each camera, ascending, on one clock.
    Returns: (k,) s, or None.
    """
    for one in frames:
        for other in frames:
            if len(one) <= len(other) and len(one):
                apart = np.abs(other[nearest(other, one)] - one)
                if np.median(apart) > within:
                    return None
    stamps = np.sort(np.concatenate(frames))
    if not len(stamps):
        return None
    group = np.concatenate(([0], np.cumsum(np.diff(stamps) > within)))
    return np.asarray(np.bincount(group, stamps) / np.bincount(group))
