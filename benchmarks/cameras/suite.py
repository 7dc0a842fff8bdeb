"""Runs `ballfg-bench cameras`, from rendered videos to states, against the truth."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import cv2
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from ballfg.benchmarks.cameras.clocks import FACTORS, NAIVE, Velocities, clocks, compare, sighted
from ballfg.benchmarks.cameras.rallies import run_rallies, run_standing
from ballfg.benchmarks.cameras.scenes import Filmed, Judged, Scenario, film, judge, scenarios
from ballfg.benchmarks.metrics import bootstrap, median_and_quartiles, median_and_range, pooled_rms, ratio, share
from ballfg.benchmarks.pictures import BLUE, ORANGE, save
from ballfg.benchmarks.results import Results, in_processes
from ballfg.benchmarks.speed.stopwatch import milliseconds
from ballfg.dynamics import nominal_model
from ballfg.estimation import Online, Settings
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.parallel.processes import Processes
from ballfg.progress import progress
from ballfg.simulation.scene.config import Clock
from ballfg.simulation.scene.recording import write_scene
from ballfg.vision import Camera, Detections, associate, check_agreement, detect_all, track_detections


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


TURN: Final = 0.5  # Degrees
AXES: Final = {"right": 0, "down": 1, "forward": 2}  # Axes of a camera's frame that it is turned about


@dataclass(frozen=True)
class Turn:
    """One camera turned about one axis.

    Attributes:
        camera, axis: the turned camera and its axis.  named: the camera that the check names, None for none.
        found: degrees by which the check finds the camera turned; NaN where it finds nothing.
    """

    camera: str
    axis: str
    named: str | None
    found: float


def turns(filmed: Filmed) -> Iterator[Turn]:
    """Each camera turned about each axis in its declared calibration; the videos stay as they are."""
    cameras = filmed.recording.cameras
    for number, camera in enumerate(cameras):
        for axis, column in AXES.items():
            rig = [turned(c, column) if k == number else c for k, c in enumerate(cameras)]
            agreement = check_agreement(associate(filmed.detections, rig), rig)
            about = agreement.by_camera.get(camera.name)
            found = float("nan") if about is None else about.rotation
            yield Turn(camera.name, axis, agreement.culprit, found)


def turned(camera: Camera, axis: int) -> Camera:
    """The camera at the same place, turned by `TURN` about an axis of its own frame."""
    turn, _ = cv2.Rodrigues(np.radians(TURN) * np.eye(3)[axis])
    rotation = turn @ camera.rotation
    return replace(camera, rvec=cv2.Rodrigues(rotation)[0].ravel(), tvec=-rotation @ camera.centre)


def errors_picture(errors: Mapping[str, NDArray[np.float64]], path: Path) -> Path:
    """The share of points within a distance of the truth, a curve for the errors (n, 3) m of each recording."""
    figure, axes = plt.subplots(figsize=(7.4, 4.2), layout="constrained")
    for name, error in errors.items():
        distance = np.sort(1e3 * np.linalg.norm(error, axis=1))
        axes.plot(distance, np.arange(1, len(distance) + 1) / len(distance), label=f"{name} ({len(distance)} points)")
    axes.set(xscale="log", xlabel="distance from the truth, mm", ylabel="share of points within", ylim=(0, 1.01))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")
    axes.set_title("Rendered scenes, three 1280x720 cameras: points against the truth", size=11)
    return save(figure, path)


def turns_picture(turns: Sequence[Turn], path: Path) -> Path:
    """The turn that is found of each camera that was turned, by axis; crossed out where another camera is named."""
    figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
    for place, turn in enumerate(turns):
        right = turn.named == turn.camera
        axes.plot(place, turn.found, "o" if right else "x", color=BLUE if right else ORANGE, markersize=8)
    axes.axhline(TURN, color="black", linewidth=0.8, linestyle="--", label=f"turned by {TURN:g} degrees")
    axes.set_xticks(range(len(turns)), [f"{turn.camera}\n{turn.axis}" for turn in turns], fontsize=8)
    axes.set(xlabel="camera, and the axis it was turned about", ylabel="turn found, degrees", ylim=(0, 2 * TURN))
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize=8)
    axes.set_title("A turned camera: named (dots) or not (crosses)", size=11)
    return save(figure, path)


LATE: Final = {"right": 0.004}  # s, delay of the stamps in recordings with a late clock


@dataclass(frozen=True)
class Size:
    """The amount of computation.

    Attributes:
        shots: balls in each recording.  late: recordings with a late clock.
        rallies: of a camera that pans and zooms, at each rate, Hz.  minutes: of a camera that stands.
        speed_runs: times that the streams are timed; the median counts.
    """

    shots: int
    late: int
    rallies: Mapping[float, int]
    minutes: int = 0
    speed_runs: int = 3


FULL: Final = Size(shots=8, late=3, rallies={25.0: 4, 60.0: 2}, minutes=2)
QUICK: Final = Size(shots=2, late=1, rallies={25.0: 1})


def run_cameras(results: Results, out: Path, size: Size, jobs: int) -> list[Path]:
    """Film, track, judge, and add the rows. Returns: the pictures written to the existing folder `out`."""
    ways = scenarios(size.shots, results.seed)
    clocks_late = {name: Clock(offset=offset) for name, offset in LATE.items()}
    late = []
    for number in range(size.late):  # other shots, with a camera whose stamps are late
        config = replace(ways[1].config, seed=ways[1].config.seed + 10 + number, clocks=clocks_late)
        late.append(replace(ways[1], name=f"4 ms late, {number + 1}", config=config))
    filmed = in_processes(film, [*ways, *late], jobs, "recordings drawn and tracked")
    shown, off = filmed[: len(ways)], filmed[len(ways) :]
    judged = {one.scenario.name: judge(one) for one in shown}
    for name, found in judged.items():
        add_points(results, name, found)
    add_velocities(results, compare(shown[1]), results.seed)
    add_clocks(results, off)
    cameras = len(shown[0].recording.cameras)
    turned = list(progress(turns(shown[0]), cameras * len(AXES), "cameras turned"))
    add_turns(results, turned, shown[0])
    _add_speed(results, ways[0], shown[1], size.speed_runs)
    run_rallies(results, size.rallies, jobs)
    run_standing(results, size.minutes, jobs)
    return [
        errors_picture({name: found.errors for name, found in judged.items()}, out / "cameras_errors.png"),
        turns_picture(turned, out / "cameras_turned.png"),
    ]


def add_points(results: Results, name: str, found: Judged) -> None:
    """Errors of the points of a recording, and how many are missing or false."""
    add = partial(results.add, "rendered scenes", name)
    of_balls = len(found.errors)
    add("position_rmse", "mm", 1e3 * found.rmse, of_balls)
    add("position_nees", "1", float(found.squares.mean()), of_balls)
    add("complete", "1", share([True] * found.found + [False] * (found.seen - found.found)), found.seen)
    add("false_points", "1", share([True] * found.false + [False] * of_balls), of_balls + found.false)
    add("tracks_per_ball", "1", found.tracks / found.balls, found.balls)
    add("mixed_tracks", "1", found.mixed, found.tracks)


def add_velocities(results: Results, found: dict[str, Velocities], seed: int) -> None:
    """Velocity errors of each way, and of camera factors over those of the naive way on the same flights."""
    add, rng = partial(results.add, "unsynchronised"), np.random.default_rng(seed)
    flown = np.all([v.counts > 0 for v in found.values()], axis=0)
    n = int(flown.sum())
    statistics = {name: pooled_rms(v.squares[flown], v.counts[flown]) for name, v in found.items()}
    for name, velocities in found.items():
        add(name, "velocity_rmse", "m/s", bootstrap(statistics[name], n, rng), n)
        place = 1e3 * np.sqrt(velocities.positions[flown].sum() / velocities.counts[flown].sum())
        add(name, "position_rmse", "mm", place, n)
        add(name, "states", "1", int(velocities.counts.sum()), len(flown))
    figure = bootstrap(ratio(statistics[FACTORS], statistics[NAIVE]), n, rng)
    add(f"{FACTORS} / {NAIVE}", "velocity_rmse", "1", figure, n)


def add_clocks(results: Results, filmed: Sequence[Filmed]) -> None:
    """Error of each camera's estimated clock; the first camera's is the reference."""
    errors, scores = [], []
    for one in progress(filmed, len(filmed), "recordings searched for late clocks"):
        found = clocks(one)
        true = np.array([one.recording.clock(camera.name).offset for camera in one.recording.cameras])
        errors.append(found.offsets - true)
        scores.append((found.offsets - true)[1:] / found.sigmas[1:])
    worst = 1e3 * np.abs(errors).max(axis=0)
    for number, camera in enumerate(filmed[0].recording.cameras):
        if number:
            row = f"{camera.name}, {'late by 4 ms' if camera.name in LATE else 'on time'}"
            results.add("time offset", row, "largest_error", "ms", float(worst[number]), len(errors))
    spread = float(np.sqrt(np.square(scores).mean()))
    results.add("time offset", "both", "rms_error_over_sigma", "1", spread, np.size(scores))


def add_turns(results: Results, found: Sequence[Turn], filmed: Filmed) -> None:
    """Share of turned cameras that are named, and as a control, of recordings without one that name any."""
    agreement = filmed.tracking.agreement
    false_alarm = agreement is not None and agreement.culprit is not None
    results.add("no camera turned", "agreement", "named", "1", float(false_alarm), 1)
    add = partial(results.add, "a camera turned by 0.5 degrees", "agreement")
    add("named", "1", share([turn.named == turn.camera for turn in found]), len(found))
    errors = [abs(turn.found - TURN) for turn in found if np.isfinite(turn.found)]
    add("largest_error_of_turn", "degree", max(errors, default=float("nan")), len(errors))


def _add_speed(results: Results, scenario: Scenario, filmed: Filmed, runs: int) -> None:
    """Frames per second and camera on the wall clock, and the latency of live sightings."""
    add, (frames, timed) = partial(results.add, "three 1280x720 streams"), stream_times(scenario, runs)
    name = "a process for each camera"
    figure = median_and_range([frames / (searching + associating) for searching, associating in timed])
    add(name, "frames_per_second_and_camera", "Hz", figure, frames)
    add(name, "association", "s", float(np.median([associating for _, associating in timed])), 1)
    pushes = push_times(filmed)
    add("online", "push_sighting", "ms", median_and_quartiles(pushes), len(pushes))
    add("online", "push_sighting_p95", "ms", float(np.quantile(pushes, 0.95)), len(pushes))
