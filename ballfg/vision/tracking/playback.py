"""Several cameras played back together: one clock, and the frame of each camera that is nearest to it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.vision.arrays import Array, Image, Rows
from ballfg.vision.association.gathering import nearest
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

HELD: Final = 0.1
"""s that a camera's frame stays on show where its next ones are missing: long enough to bridge dropped frames, short
enough that a picture never shows a ball that has long gone."""


@dataclass(frozen=True, eq=False)
class Schedule:
    """What is on show when."""

    times: Array
    """(k,) s, true time of each moment, increasing."""

    frames: Rows
    """(k, c) number of the frame of each camera; -1 where it has none within `HELD`."""


def schedule(detections: Sequence[Detections], cameras: Sequence[Camera]) -> Schedule:
    """The moments at which to show a recording: the frames of the camera with most, and where it is silent the others'.

    Only the stamps of the detections' frames and the cameras' time offsets are used.
    """
    clocks = [seen.frames - camera.time_offset for seen, camera in zip(detections, cameras, strict=True)]
    times = np.zeros(0)
    for clock in sorted(clocks, key=len, reverse=True):
        if len(times) == 0:
            times = clock
        elif len(clock):
            times = np.concatenate((clock[clock < times[0]], times, clock[clock > times[-1]]))
    return Schedule(times, np.column_stack([shown(clock, times) for clock in clocks]))


def shown(clock: Array, times: Array) -> Rows:
    """(k,) index into `clock` (f,), increasing, of the stamp nearest to each of `times` (k,); -1 beyond `HELD`."""
    if len(clock) == 0:
        return np.full(len(times), -1, dtype=np.int64)
    index = nearest(clock, times)
    return np.where(np.abs(clock[index] - times) <= HELD, index, -1).astype(np.int64)


def play(moments: Schedule, streams: Sequence[Iterator[tuple[float, Image]]]) -> Iterator[list[Image | None]]:
    """The images of each moment, one of each camera; None where it has none.

    Args: streams: of each camera, from its first frame on; each is run through once.
    """
    at = [-1] * len(streams)
    images: list[Image | None] = [None] * len(streams)
    for frames in moments.frames:
        for i, wanted in enumerate(frames):
            while at[i] < wanted:
                _, images[i] = next(streams[i])
                at[i] += 1
        yield [image if frame >= 0 else None for image, frame in zip(images, frames, strict=True)]
