"""Times the tracking of three video streams, and live updates from sightings."""

import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ballfg.benchmarks.cameras.clocks import sighted
from ballfg.benchmarks.cameras.scenes import Filmed, Scenario
from ballfg.benchmarks.speed.stopwatch import milliseconds
from ballfg.dynamics import nominal_model
from ballfg.estimation import Online, Settings
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.parallel.processes import Processes
from ballfg.progress import progress
from ballfg.simulation.scene.writing import write_scene
from ballfg.vision import Detections, detect_all, track_detections


def stream_times(scenario: Scenario, runs: int) -> tuple[int, list[tuple[float, float]]]:
    """Draws the videos, then times what `ballfg track` does before it draws pictures: a process for each camera.

    Returns: frames of each camera; for each run the s from videos to candidates, with the start of the processes, and
        the s from candidates to balls and to whether the cameras agree.
    """
    recording, times, frames = scenario.recording(), [], 0
    with TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        images = f"frames of {scenario.name}, timed"
        write_scene(scene, recording, watch=lambda items, total, _: progress(items, total, images))
        videos = {camera.name: scene / f"{camera.name}.mp4" for camera in recording.cameras}
        for _ in progress(range(runs), runs, "runs timed"):
            Processes(len(videos), helped=False).stop()  # each run starts its processes, as the command does
            start = time.perf_counter()
            found: dict[str, Detections] = detect_all(videos, jobs=len(videos))
            searched = time.perf_counter()
            track_detections(list(found.values()), recording.cameras)
            times.append((searched - start, time.perf_counter() - searched))
            frames = min(len(detections.frames) for detections in found.values())
    return frames, times


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
