"""Computes the true balls of a recording at any time, each camera's exposures and stamps, and the balls meanwhile.

From the last knot the simulator's own integration runs on to the requested time, through a contact if there is one:
nothing is interpolated, so that a bounce stays as sharp as in the simulator.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.dynamics import AnalyticModel, Surfaces
from ballfg.dynamics.motion.rollout import advance
from ballfg.simulation.config import MotionNoise
from ballfg.simulation.motion import simulate_motion
from ballfg.simulation.scene.config import Clock, SceneConfig
from ballfg.simulation.settings import settings_of_shots
from ballfg.simulation.streams import Purpose, cut_normal, generator
from ballfg.state import POSITION, STATE_DIM
from ballfg.vision.camera import Camera

KNOT_RATE: Final = 200.0  # Hz. A knot every 5 ms is one step of the simulator's integration
BEFORE: Final = 0.5  # s of empty scene before the first launch, and after the last flight
START_SPREAD: Final = 0.05  # s, spread of launches about their interval, so that they do not keep step with the frames


@dataclass(frozen=True, eq=False)
class Flight:
    """One ball, from its launch to the end of its track, in true time."""

    name: str  # of the track
    start: float  # s, true time of the launch
    knots: Array  # (k, 9) states every 1 / `KNOT_RATE` s from the launch on
    model: AnalyticModel = field(repr=False)  # model of its motion
    surfaces: Surfaces = field(repr=False)  # its surfaces

    @property
    def end(self) -> float:
        """True time in s of the last knot, at which the ball disappears."""
        return self.start + (len(self.knots) - 1) / KNOT_RATE

    @torch.no_grad()
    def states(self, times: ArrayLike) -> Array:
        """(..., 9) states at true times (...) s.

        Raises: ValueError: a time before the launch or after the end.
        """
        times = np.asarray(times, dtype=np.float64)
        flat = times.reshape(-1)
        if flat.size and not (self.start <= flat.min() and flat.max() <= self.end):
            raise ValueError(
                f"times must lie in the flight {shown(self.name)}, {self.start:.4f} to {self.end:.4f} s; "
                f"got {flat.min():.4f} to {flat.max():.4f} s. Ask for others."
            )
        since = flat - self.start
        knot = np.clip(np.floor(since * KNOT_RATE).astype(np.int64), 0, len(self.knots) - 1)
        left = np.maximum(since - knot / KNOT_RATE, 0.0)
        after = advance(self.model, torch.from_numpy(self.knots[knot]), torch.from_numpy(left), self.surfaces)
        return np.asarray(after.numpy()).reshape(*times.shape, STATE_DIM)


def fly_shots(config: SceneConfig) -> list[Flight]:
    """The flights of a recording, in the order of their launches, named "000", "001" ..."""
    kind, model, seed = config.ball, config.model(), config.seed
    settings = settings_of_shots(config.combinations(), 0, config.shots, seed)
    first = kind.launcher.launch(settings, kind.surfaces.table_height, generator(seed, Purpose.LAUNCH, 0))
    motion = simulate_motion(
        model, first, KNOT_RATE, kind.surfaces, kind.launcher, MotionNoise(), generator(seed, Purpose.PROCESS, 0)
    )
    spread = START_SPREAD * generator(seed, Purpose.SCENE_START).random(config.shots)
    starts = BEFORE + config.interval * np.arange(config.shots) + spread
    width = max(3, len(str(config.shots - 1)))
    return [
        Flight(f"{i:0{width}d}", float(starts[i]), motion.states[i, : motion.lengths[i]], model, kind.surfaces)
        for i in range(config.shots)
    ]


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


def frames_of(config: SceneConfig, camera: Camera, number: int, flights: Sequence[Flight]) -> Frames:
    """The frames of a camera from its first one to the end of the recording, soon after that of the last flight.

    Args:
        config: rate, clocks, dropped frames, jitter.  camera: for its name and its known time offset.
        number: of the camera in its rig; it picks the random streams.
    """
    clock = config.clocks.get(camera.name, Clock())
    until = max(flight.end for flight in flights) + BEFORE
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
