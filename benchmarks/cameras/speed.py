"""Times of tracking: three video streams through detection and association, and live updates from sightings."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ballfg.benchmarks.cameras.clocks import sighted
from ballfg.benchmarks.cameras.scenes import Filmed, Scenario
from ballfg.benchmarks.speed.stopwatch import milliseconds
from ballfg.dynamics import nominal_model
from ballfg.estimation import Online, Settings, sightings_of
from ballfg.parallel.processes import Processes
from ballfg.progress import progress
from ballfg.simulation.scene import write_scene
from ballfg.vision import Camera, Detections, detect_all, track_detections


@dataclass(frozen=True)
class StreamTimes:
    """Wall-clock times of one recording.

    Attributes:
        frames: of each camera.
        searching: s, videos to candidates, with the start of the processes.
        associating: s, candidates to balls, and whether the cameras agree.
    """

    frames: int
    searching: float
    associating: float

    @property
    def rate(self) -> float:
        """Frames per second of each camera, everything included."""
        return self.frames / (self.searching + self.associating)


def stream_times(scenario: Scenario, runs: int) -> list[StreamTimes]:
    """Draws the videos, then times what `ballfg track` does before it draws pictures: a process for each camera."""
    recording = scenario.recording()
    with TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        images = f"frames of {scenario.name}, timed"
        write_scene(scene, recording, watch=lambda items, total, _: progress(items, total, images))
        videos = {camera.name: scene / f"{camera.name}.mp4" for camera in recording.cameras}
        return [_timed(videos, recording.cameras) for _ in progress(range(runs), runs, "runs timed")]


def _timed(videos: dict[str, Path], cameras: Sequence[Camera]) -> StreamTimes:
    Processes(len(videos), helped=False).stop()  # each run starts its processes, as the command does
    start = time.perf_counter()
    found: dict[str, Detections] = detect_all(videos, jobs=len(videos))
    searched = time.perf_counter()
    track_detections(list(found.values()), cameras)
    end = time.perf_counter()
    return StreamTimes(min(len(d.frames) for d in found.values()), searched - start, end - searched)


def push_times(filmed: Filmed) -> list[float]:
    """Milliseconds of each sighting that the online estimator takes in, those of all balls."""
    settings, taken = Settings.for_measured(nominal_model()), []
    tracks = sighted(filmed)
    for track in progress(tracks, len(tracks), "balls pushed online"):
        rig = sightings_of(track)
        online = Online(nominal_model(), filmed.recording.config.ball.surfaces, settings, cameras=rig.cameras)
        seen = rig.sightings
        for camera, at, pixel, covariance in zip(seen.camera, seen.times, seen.pixels, seen.covariances, strict=True):
            push = partial(online.push_sighting, float(at), seen.cameras[camera], pixel, covariance)
            taken.append(milliseconds(push))
    return taken
