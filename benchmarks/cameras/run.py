"""`ballfg-bench cameras`: from rendered videos to states, against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import joblib
import numpy as np
import torch

from ballfg.benchmarks.cameras.calibration import Nudge, nudges
from ballfg.benchmarks.cameras.clocks import Velocities, clocks, compare
from ballfg.benchmarks.cameras.scenes import Filmed, Judged, Scenario, film, judge, scenarios
from ballfg.benchmarks.cameras.speed import push_times, stream_times
from ballfg.benchmarks.diagnosis.limit import share
from ballfg.benchmarks.metrics import Figure, bootstrap, pooled_rms, ratio
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.timing import quartiles
from ballfg.progress import progress
from ballfg.simulation.scene import Clock

__all__ = ["FULL", "QUICK", "run_cameras"]

LATE: Final = {"right": 0.004}
"""s, by which cameras' stamps are late in the recordings whose clocks are to be found."""
NAIVE, FACTORS = "smoother, as if synchronised", "smoother, camera factors"
SPEED_RUNS: Final = 3
"""Times that the streams are timed; the median counts."""


@dataclass(frozen=True)
class Size:
    """How much is done: balls in each recording, and recordings whose clocks are off."""

    shots: int
    late: int


FULL: Final = Size(shots=8, late=3)
QUICK: Final = Size(shots=2, late=1)


def run_cameras(results: Results, out: Path, size: Size, jobs: int) -> list[Path]:
    """Film, track, judge, and add the rows.

    Args:
        results: gets the rows.
        out: an existing folder.
        size: how much.
        jobs: processes.
    Returns: the pictures written.
    """
    from ballfg.benchmarks.cameras.pictures import errors_picture, turns_picture

    ways = scenarios(size.shots, results.seed)
    late = [_late(ways[1], number) for number in range(size.late)]
    filmed = _film_all([*ways, *late], jobs)
    shown, off = filmed[: len(ways)], filmed[len(ways) :]
    judged = [judge(f) for f in shown]
    for f, found in zip(shown, judged, strict=True):
        _add_points(results, f.scenario.name, found)
    _add_velocities(results, compare(shown[1]), results.seed)
    _add_clocks(results, off)
    turned = list(progress(nudges(shown[0]), 9, "cameras turned"))
    _add_nudges(results, turned, shown[0])
    _add_speed(results, ways[0], shown[1])
    names = [f.scenario.name for f in shown]
    return [
        errors_picture(names, [j.errors for j in judged], out / "cameras_errors.png"),
        turns_picture(turned, out / "cameras_turned.png"),
    ]


def _late(scenario: Scenario, number: int) -> Scenario:
    """The scenario with a camera whose stamps are late, and other shots."""
    config = scenario.config
    clocks_of = {name: Clock(offset=offset) for name, offset in LATE.items()}
    seed = config.seed + 10 + number
    return replace(scenario, name=f"4 ms late, {number + 1}", config=replace(config, seed=seed, clocks=clocks_of))


def _film_all(wanted: Sequence[Scenario], jobs: int) -> list[Filmed]:
    """All recordings, side by side."""
    if jobs == 1:
        return [film(scenario) for scenario in wanted]
    pool = joblib.Parallel(n_jobs=min(jobs, len(wanted)), return_as="generator")
    made = pool(joblib.delayed(_filmed)(scenario) for scenario in wanted)
    return list(progress(made, len(wanted), "recordings drawn and tracked"))


def _filmed(scenario: Scenario) -> Filmed:
    torch.set_num_threads(1)  # the processes share the cores already
    return film(scenario, quiet=True)


def _add_points(results: Results, name: str, found: Judged) -> None:
    """What is right about the points of a recording."""
    add = partial(results.add, "rendered scenes", name)
    points = len(found.errors) + found.false
    add("position_rmse", "mm", 1e3 * found.rmse, len(found.errors))
    add("position_nees", "1", float(found.squares.mean()), len(found.errors))
    add("complete", "1", share([True] * found.found + [False] * (found.seen - found.found)), found.seen)
    add("false_points", "1", share([True] * found.false + [False] * len(found.errors)), points)
    add("tracks_per_ball", "1", found.tracks / found.balls, found.balls)
    add("mixed_tracks", "1", found.mixed, found.tracks)


def _add_velocities(results: Results, found: dict[str, Velocities], seed: int) -> None:
    """Velocity errors of each way, and of camera factors over those of the naive way on the same flights."""
    rng = np.random.default_rng(seed)
    flown = np.all([v.counts > 0 for v in found.values()], axis=0)
    for name, velocities in found.items():
        kept = pooled_rms(velocities.squares[flown], velocities.counts[flown])
        results.add("unsynchronised", name, "velocity_rmse", "m/s", bootstrap(kept, int(flown.sum()), rng), flown.sum())
        place = 1e3 * np.sqrt(velocities.positions[flown].sum() / velocities.counts[flown].sum())
        results.add("unsynchronised", name, "position_rmse", "mm", place, flown.sum())
        results.add("unsynchronised", name, "states", "1", int(velocities.counts.sum()), len(flown))
    above, below = (pooled_rms(found[name].squares[flown], found[name].counts[flown]) for name in (FACTORS, NAIVE))
    figure = bootstrap(ratio(above, below), int(flown.sum()), rng)
    results.add("unsynchronised", f"{FACTORS} / {NAIVE}", "velocity_rmse", "1", figure, flown.sum())


def _add_clocks(results: Results, filmed: Sequence[Filmed]) -> None:
    """How far each camera's clock is from what it was found to be; the first camera's is the reference."""
    errors, scores = [], []
    for f in filmed:
        found = clocks(f)
        true = np.array([f.recording.clock(camera.name).offset for camera in f.recording.cameras])
        errors.append(found.offsets - true)
        scores.append((found.offsets - true)[1:] / found.sigmas[1:])
    error, names = np.array(errors), [camera.name for camera in filmed[0].recording.cameras]
    for number, name in enumerate(names[1:], start=1):
        worst = float(np.abs(error[:, number]).max())
        what = "late by 4 ms" if name in LATE else "on time"
        results.add("time offset", f"{name}, {what}", "largest_error", "ms", 1e3 * worst, len(error))
    results.add(
        "time offset", "both", "rms_error_over_sigma", "1", float(np.sqrt(np.square(scores).mean())), np.size(scores)
    )


def _add_nudges(results: Results, found: Sequence[Nudge], filmed: Filmed) -> None:
    """How often the turned camera is the one that is named; as a control, whether one is where none was turned."""
    said = filmed.tracking.agreement
    innocent = said is not None and said.culprit is not None
    results.add("no camera turned", "agreement", "named", "1", float(innocent), 1)
    right = [nudge.named == nudge.camera for nudge in found]
    results.add("a camera turned by 0.5 degrees", "agreement", "named", "1", share(right), len(right))
    turns = [abs(nudge.turn - 0.5) for nudge in found if np.isfinite(nudge.turn)]
    worst = max(turns, default=float("nan"))
    results.add("a camera turned by 0.5 degrees", "agreement", "largest_error_of_turn", "degree", worst, len(turns))


def _add_speed(results: Results, scenario: Scenario, filmed: Filmed) -> None:
    """Frames per second and camera on the wall clock, and the latency of live sightings."""
    runs = stream_times(scenario, SPEED_RUNS)
    rates = np.array([run.rate for run in runs])
    figure = Figure(float(np.median(rates)), float(rates.min()), float(rates.max()))
    name = "a process for each camera"
    results.add("three 1280x720 streams", name, "frames_per_second_and_camera", "Hz", figure, runs[0].frames)
    results.add("three 1280x720 streams", name, "association", "s", float(np.median([r.associating for r in runs])), 1)
    pushes = push_times(filmed)
    results.add("three 1280x720 streams", "online", "push_sighting", "ms", quartiles(pushes), len(pushes))
    results.add(
        "three 1280x720 streams", "online", "push_sighting_p95", "ms", float(np.quantile(pushes, 0.95)), len(pushes)
    )
