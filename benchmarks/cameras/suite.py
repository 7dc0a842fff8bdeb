"""Runs `ballfg-bench cameras`, from rendered videos to states, against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.benchmarks.cameras.clocks import FACTORS, NAIVE, Velocities, clocks, compare
from ballfg.benchmarks.cameras.scenes import Filmed, Judged, Scenario, film, judge, scenarios
from ballfg.benchmarks.cameras.speed import push_times, stream_times
from ballfg.benchmarks.cameras.turned import AXES, TURN, Turn, turns
from ballfg.benchmarks.metrics import bootstrap, median_and_quartiles, median_and_range, pooled_rms, ratio, share
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.resumable import in_processes
from ballfg.progress import progress
from ballfg.simulation.scene.config import Clock

LATE: Final = {"right": 0.004}  # s, delay of the stamps in recordings with a late clock


@dataclass(frozen=True)
class Size:
    """The amount of computation.

    Attributes:
        shots: balls in each recording.  late: recordings with a late clock.
        speed_runs: times that the streams are timed; the median counts.
    """

    shots: int
    late: int
    speed_runs: int = 3


FULL: Final = Size(shots=8, late=3)
QUICK: Final = Size(shots=2, late=1)


def run_cameras(results: Results, out: Path, size: Size, jobs: int) -> list[Path]:
    """Film, track, judge, and add the rows. Returns: the pictures written to the existing folder `out`."""
    from ballfg.benchmarks.cameras.pictures import errors_picture, turns_picture

    ways = scenarios(size.shots, results.seed)
    late = [_late(ways[1], number) for number in range(size.late)]
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
    return [
        errors_picture({name: found.errors for name, found in judged.items()}, out / "cameras_errors.png"),
        turns_picture(turned, out / "cameras_turned.png"),
    ]


def _late(scenario: Scenario, number: int) -> Scenario:
    """The scenario with a camera whose stamps are late, and other shots."""
    late = {name: Clock(offset=offset) for name, offset in LATE.items()}
    config = replace(scenario.config, seed=scenario.config.seed + 10 + number, clocks=late)
    return replace(scenario, name=f"4 ms late, {number + 1}", config=config)


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
