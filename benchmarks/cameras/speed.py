"""What tracking costs: three video streams through detection and association, and live updates from sightings."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from joblib.externals.loky import get_reusable_executor
from numpy.typing import NDArray

from ballfg.benchmarks.cameras.clocks import sighted
from ballfg.benchmarks.cameras.scenes import Filmed, Scenario, draw
from ballfg.dynamics import nominal_model
from ballfg.estimation import Online, Settings
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.vision import Camera, Detections, detect_all, track_detections

Array = NDArray[np.float64]


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
        draw(recording, scene, f"{scenario.name}, timed")
        videos = {camera.name: scene / f"{camera.name}.mp4" for camera in recording.cameras}
        return [_timed(videos, recording.cameras) for _ in range(runs)]


def _timed(videos: dict[str, Path], cameras: Sequence[Camera]) -> StreamTimes:
    get_reusable_executor().shutdown(wait=True)  # each run starts its processes, as the command does
    start = time.perf_counter()
    found: dict[str, Detections] = detect_all(videos, jobs=len(videos))
    searched = time.perf_counter()
    track_detections(list(found.values()), cameras)
    end = time.perf_counter()
    return StreamTimes(min(len(d.frames) for d in found.values()), searched - start, end - searched)


def push_times(filmed: Filmed) -> Array:
    """(n,) ms, of each sighting that the online estimator takes in, those of all balls."""
    settings, taken = Settings.for_measured(nominal_model()), []
    for track in sighted(filmed):
        seen = sightings_of(track)
        online = Online(nominal_model(), filmed.recording.config.ball.surfaces, settings, cameras=seen.cameras)
        rows = seen.sightings
        for camera, at, pixel, covariance in zip(rows.camera, rows.times, rows.pixels, rows.covariances, strict=True):
            start = time.perf_counter()
            online.push_sighting(float(at), rows.cameras[camera], pixel, covariance)
            taken.append(1e3 * (time.perf_counter() - start))
    return np.array(taken)
