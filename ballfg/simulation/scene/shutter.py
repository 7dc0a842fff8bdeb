"""Computes each camera's exposures, its stamps, and the places of the balls meanwhile."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.simulation.scene.config import Clock, SceneConfig
from ballfg.simulation.scene.flights import Flight
from ballfg.simulation.streams import Purpose, cut_normal, generator
from ballfg.state import POSITION
from ballfg.vision.camera import Camera

PATH_POINTS: Final = 17
"""Number of points of a ball's path through one exposure, the first at the opening, the last at the closing, the middle
one at the stamp. Sixteen chords: a bounce within 2 ms is off by less than 0.1 mm over one of them."""


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of one camera."""

    times: Array  # (f,) s, true time of the middle of each exposure
    stamps: Array  # (f,) s, stamps recorded by the camera


@dataclass(frozen=True, eq=False)
class Passage:
    """One ball's way through the frames of one camera, visible or not."""

    name: str  # Of the ball's track
    frames: NDArray[np.int64]
    """(n,) numbers of the frames whose whole exposure lies within the flight; in no other frame is the ball there."""
    paths: Array  # (n, `PATH_POINTS`, 3) m, its centre from the opening of the shutter to its closing, evenly in time

    @property
    def centres(self) -> Array:
        """(n, 3) m, in the middle of each exposure."""
        return self.paths[:, PATH_POINTS // 2]


def free_running(names: Sequence[str], rate: float, seed: int) -> dict[str, Clock]:
    """Clocks of unsynchronised cameras: first exposures are spread over one frame interval, never together.

    Args: rate: Hz.  seed: draws the order of cameras, each within the middle half of its own share of the interval.
    """
    rng = generator(seed, Purpose.SCENE_PHASE)
    place = rng.permutation(len(names)) + rng.uniform(0.25, 0.75, len(names))
    return {name: Clock(phase=float(p / len(names) / rate)) for name, p in zip(names, place, strict=True)}


def frames_of(config: SceneConfig, camera: Camera, number: int, until: float) -> Frames:
    """The frames of a camera from its first one on.

    Args:
        config: rate, clocks, dropped frames, jitter.  camera: for its name and its known time offset.
        number: of the camera in its rig; it picks the random streams.  until: s, true time of the end of the recording.
    """
    clock = config.clocks.get(camera.name, Clock())
    count = int(np.floor((until - clock.phase) * config.rate)) + 1
    kept = generator(config.seed, Purpose.SCENE_DROPOUT, number).random(count) >= config.dropout
    kept[0] = True
    times = clock.phase + np.arange(count) / config.rate
    jitter = config.jitter * cut_normal(generator(config.seed, Purpose.SCENE_JITTER, number), count)
    stamps = times + camera.time_offset + clock.offset + jitter
    return Frames(times[kept], stamps[kept])


def passages_of(config: SceneConfig, flights: Sequence[Flight], frames: Frames) -> list[Passage]:
    """The place of each ball during the exposures of a camera."""
    within = config.exposure * np.linspace(-0.5, 0.5, PATH_POINTS)
    passages = []
    for flight in flights:
        there = (frames.times + within[0] >= flight.start) & (frames.times + within[-1] <= flight.end)
        number = np.flatnonzero(there).astype(np.int64)
        states = flight.states(frames.times[number, None] + within)
        passages.append(Passage(flight.name, number, states[..., POSITION]))
    return passages
