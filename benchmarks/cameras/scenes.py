"""Films recordings with known truth, tracks them from their videos, and judges each point."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.benchmarks.metrics import nees, root_mean_square
from ballfg.simulation.cameras import table_rig
from ballfg.simulation.scene.config import SceneConfig
from ballfg.simulation.scene.recording import Recording, record, write_scene
from ballfg.simulation.scene.shutter import Flight, free_running
from ballfg.vision.association.gathering import SeenBall, nearest
from ballfg.vision.detection.detect import detect_all
from ballfg.vision.detection.detections import Detections
from ballfg.vision.tracking.pipeline import Tracking, track_detections

FALSE: Final = 0.05  # m. Distance from every ball beyond which a point is false.
MIXED: Final = 3
"""Points of a second ball that make a track one of two balls; where two nearly touch, a point or two may seem to be."""
SAME_FRAME: Final = 0.5  # Share of a frame interval within which a point belongs to a frame


@dataclass(frozen=True)
class Scenario:
    """One recording setup: the name of its rows, the scene, and whether all cameras expose at once."""

    name: str
    config: SceneConfig
    shared: bool = True

    def recording(self) -> Recording:
        """The balls and the frames, before anything is drawn."""
        rig = table_rig()
        if self.shared:
            return record(self.config, rig)
        clocks = free_running([camera.name for camera in rig], self.config.rate, self.config.seed)
        for name, given in self.config.clocks.items():
            clocks[name] = replace(clocks[name], offset=given.offset)
        return record(replace(self.config, clocks=clocks), rig)


def scenarios(shots: int, seed: int) -> list[Scenario]:
    """The ways to film that the benchmark goes through, each with so many balls; seeds count up from the first."""
    base = SceneConfig(shots=shots, seed=seed)
    slow = replace(base, rate=60.0, exposure=0.004, colour="orange")
    return [
        Scenario("synchronised, 120 Hz", base),
        Scenario("unsynchronised, 120 Hz", replace(base, seed=seed + 1), shared=False),
        Scenario("two balls at once", replace(base, seed=seed + 2, interval=0.7)),
        Scenario("60 Hz, shutter 4 ms, orange", replace(slow, seed=seed + 3)),
        Scenario("dropped frames 10 %, noisy", replace(base, seed=seed + 4, dropout=0.1, noise=4.0)),
    ]


@dataclass(frozen=True, eq=False)
class Filmed:
    """A recording and the tracking of its videos."""

    scenario: Scenario
    recording: Recording
    detections: tuple[Detections, ...]
    tracking: Tracking


def film(scenario: Scenario) -> Filmed:
    """Draws a scenario into videos and tracks the balls in them; the videos are deleted again."""
    recording = scenario.recording()
    with TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        write_scene(scene, recording)
        names = [camera.name for camera in recording.cameras]
        found = detect_all(
            {name: scene / f"{name}.mp4" for name in names},
            stamps={name: scene / f"{name}_stamps.csv" for name in names},
        )
    detections = tuple(found.values())
    return Filmed(scenario, recording, detections, track_detections(detections, recording.cameras))


@dataclass(frozen=True, eq=False)
class Judged:
    """The points of balls against the truth.

    Attributes:
        errors: (n, 3) m, of points that belong to a ball.  squares: (n,) NEES of these.
        false: number of points that belong to no ball.
        seen: frames in which two cameras or more see a ball.  found: those that have a point.
        tracks: found.  mixed: those with points of more than one ball.  balls: launched.
    """

    errors: Array
    squares: Array
    false: int
    seen: int
    found: int
    tracks: int
    mixed: int
    balls: int

    @property
    def rmse(self) -> float:
        """Root mean square distance, m."""
        return root_mean_square(self.errors)


def judge(filmed: Filmed) -> Judged:
    """Each point against the nearest ball in the air at its time; each frame with a ball against the points."""
    recording = filmed.recording
    errors, squares = [np.zeros((0, 3))], [np.zeros(0)]
    false, mixed, at = 0, 0, {flight.name: [np.empty(0)] for flight in recording.flights}
    for ball in filmed.tracking.balls:
        flight, error = _nearest(recording.flights, ball)
        of_ball = np.linalg.norm(error, axis=1) <= FALSE
        false += int((~of_ball).sum())
        errors.append(error[of_ball])
        squares.append(nees(error[of_ball], ball.covariances[of_ball]))
        names, counts = np.unique(flight[of_ball], return_counts=True)
        mixed += int((counts >= MIXED).sum() > 1)
        for name in names:
            at[name].append(ball.times[of_ball & (flight == name)])
    seen = found = 0
    for name, times in _frames_with_ball(recording):
        points = np.sort(np.concatenate(at[name]))
        seen += len(times)
        found += int((_distance(times, points) < SAME_FRAME / recording.config.rate).sum())
    tracks, balls = len(filmed.tracking.balls), len(recording.flights)
    return Judged(np.concatenate(errors), np.concatenate(squares), false, seen, found, tracks, mixed, balls)


def truth_at(flight: Flight, times: Array) -> Array:
    """(n, 9) states at true times, NaN outside the flight."""
    states = np.full((len(times), 9), np.nan)
    inside = (times >= flight.start) & (times <= flight.end)
    states[inside] = flight.states(times[inside])
    return states


def _nearest(flights: tuple[Flight, ...], ball: SeenBall) -> tuple[NDArray[np.str_], Array]:
    """For each point the nearest flight's name (n,) and the error (n, 3) m; infinite where nothing flies."""
    errors = np.stack([ball.points - truth_at(flight, ball.times)[:, :3] for flight in flights])
    errors[np.isnan(errors)] = np.inf
    best = np.linalg.norm(errors, axis=-1).argmin(axis=0)
    names = np.array([flight.name for flight in flights])
    return names[best], errors[best, np.arange(len(best))]


def _frames_with_ball(recording: Recording) -> Iterator[tuple[str, Array]]:
    """For each ball the true times of the frames that have its centre in the image while another camera has.

    Cameras that share a shutter have one frame together. Of cameras that do not, a frame of the one that sees most of
    the ball counts if another one sees the ball within a frame interval before and after.
    """
    step = 1.0 / recording.config.rate
    shared = len({recording.clock(camera.name).phase for camera in recording.cameras}) == 1
    for number, flight in enumerate(recording.flights):
        times = [
            frames.times[passages[number].frames[camera.in_view(passages[number].centres)]]
            for camera, frames, passages in zip(recording.cameras, recording.frames, recording.passages, strict=True)
        ]
        if shared:
            stamps, views = np.unique(np.round(np.concatenate(times), 6), return_counts=True)
            yield flight.name, np.asarray(stamps[views >= 2], dtype=np.float64)
        else:
            own = times.pop(int(np.argmax([len(t) for t in times])))
            near = [(own >= t.min()) & (own <= t.max()) & (_distance(own, t) <= step) for t in times if len(t)]
            yield flight.name, own[np.any(near, axis=0)]


def _distance(times: Array, others: Array) -> Array:
    """(n,) s from each time to the nearest of the others, which ascend."""
    if not len(others):
        return np.full(len(times), np.inf)
    return np.asarray(np.abs(times - others[nearest(others, times)]))
