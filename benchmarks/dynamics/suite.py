"""Runs `ballfg-bench dynamics`: every method learns from the same shots and predicts the same others."""

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.benchmarks.dynamics.contenders import Record
from ballfg.benchmarks.dynamics.jobs import METHODS, TIMED, collect_records
from ballfg.benchmarks.dynamics.measured import Measured, measured_tasks
from ballfg.benchmarks.dynamics.task import APEXES, Task, pooled_rmse
from ballfg.benchmarks.dynamics.truth import TRACKS, synthetic_task
from ballfg.benchmarks.metrics import Figure
from ballfg.benchmarks.results import CURVE_MARK, RUNS_FOLDER, Results


def add_rows(results: Results, task: Task, records: Sequence[Record]) -> None:
    """The rows of one method: means over the seeds, from the lowest to the highest seed; each seed by itself at `@`.

    Figures that a method does not have are left out: one that predicts only what comes after the observed part has no
    error over the whole track.
    """
    method, measured = records[0].method, task.truth is None
    by_seed = [{figure[0]: figure for figure in figures(record, measured)} for record in records]
    for name, (_, unit, value, n) in by_seed[0].items():
        values = [found[name][2] for found in by_seed]
        if len(values) == 1:
            results.add(task.case, method, name, unit, float(value), n)
            continue
        results.add(task.case, method, name, unit, Figure(float(np.mean(values)), min(values), max(values)), n)
        for record, one in zip(records, values, strict=True):
            results.add(task.case, method, f"{name}{CURVE_MARK}{record.seed}", unit, one, n)


def figures(record: Record, measured: bool) -> Iterator[tuple[str, str, float, int]]:
    """Metric, unit, value and number of tracks of every figure of one contender.

    On measured tracks `prediction_rmse_median` is the figure of `ballfg-bench estimators --data`, in its unit.
    """
    scores = record.scores
    n = len(scores)
    if all(s.track[0] is not None for s in scores):
        yield "track_rmse", "m", pooled_rmse([s.track for s in scores]), n
        yield "track_rmse_median", "m", float(np.median([s.track_rmse for s in scores])), n
    ahead = [s for s in scores if s.rest[1]]
    if ahead:
        yield "rest_rmse", "m", pooled_rmse([s.rest for s in ahead]), len(ahead)
        median = float(np.median([s.rest_rmse for s in ahead]))
        yield "rest_rmse_median", "m", median, len(ahead)
        if measured:
            yield "prediction_rmse_median", "mm", 1e3 * median, len(ahead)
    errors, later = np.array([s.apex for s in scores], dtype=np.float64), np.array([s.apex_ahead for s in scores])
    for suffix, counted in (("", np.isfinite(errors)), ("_ahead", np.isfinite(errors) & later)):
        for flight, name in enumerate(APEXES):  # of all, and of those after the observed part
            found = errors[counted[:, flight], flight]
            if len(found):
                yield f"apex_{name}{suffix}_mean", "m", float(found.mean()), len(found)
                yield f"apex_{name}{suffix}_std", "m", float(found.std()), len(found)
    yield "parameters", "1", record.parameters, 1
    yield "training_time", "s", record.training_time, 1
    yield "inference_time", "s", record.inference_time, min(TIMED, n)
    yield "not_converged", "1", record.not_converged, n


@dataclass(frozen=True)
class Plan:
    """The amount of computation."""

    tracks: int  # synthetic ones
    measured: int | None  # measured tracks at most; None for all
    seeds: int  # how often each trained method is trained
    quick: bool  # train just enough to see that everything works


FULL: Final = Plan(tracks=TRACKS, measured=None, seeds=3, quick=False)
QUICK: Final = Plan(tracks=60, measured=24, seeds=1, quick=True)


def run_dynamics(
    results: Results, data: Measured | None, out: Path, plan: Plan, jobs: int, methods: Sequence[str] | None = None
) -> list[Path]:
    """Train, judge, and add the rows. Finished methods are kept in `out`: a run that was stopped goes on where it was.

    Args: methods: names in `METHODS`, None for all; those that do not take part on such tracks are passed over.
    Returns: the pictures written.
    """
    from ballfg.benchmarks.dynamics.pictures import apex_picture, fan_picture, rmse_picture

    for name in methods or ():
        if name not in METHODS:
            raise ValueError(f"--method must be one of {', '.join(METHODS)}; got '{name}'. Choose one of them.")
    chosen = _installed(methods)
    tasks = [synthetic_task(results.seed, plan.tracks)] if data is None else measured_tasks(data, jobs, plan.measured)
    for task in tasks:
        print(describe(task))
    seeds = range(results.seed, results.seed + plan.seeds)
    of_tasks = collect_records(tasks, chosen, seeds, out / RUNS_FOLDER, jobs, quick=plan.quick)
    pictures = []
    for task, records in zip(tasks, of_tasks, strict=True):
        for _, group in groupby(records, key=lambda record: record.method):
            add_rows(results, task, list(group))
        ending = "" if len(tasks) == 1 else "_" + re.sub(r"\W+", "_", task.case)
        pictures.append(rmse_picture(results.rows, task, out / f"dynamics_rmse{ending}.png"))
        if any(row.metric.startswith("apex") for row in results.rows if row.case == task.case):
            pictures.append(apex_picture(results.rows, task, out / f"dynamics_apex{ending}.png"))
        if any(record.fan is not None for record in records):
            pictures.append(fan_picture(records, task.surfaces.table_height, out / f"dynamics_fan{ending}.png"))
    return pictures


def _installed(asked: Sequence[str] | None) -> tuple[str, ...]:
    """The methods to compare; of all of them those that are installed."""
    missing = {name: METHODS[name].package for name in asked or METHODS if not METHODS[name].installed}
    for name, package in missing.items():
        remedy = f"it needs the package {package}. Install it: pip install 'ballfg[diffusion]'."
        if asked:
            raise ValueError(f"--method {name} cannot be compared: {remedy}")
        print(f"note: {name} is left out: {remedy}", file=sys.stderr)
    return tuple(name for name in asked or METHODS if name not in missing)


def describe(task: Task) -> str:
    """One line about the tracks."""
    shots = [*task.train, *task.validation]
    bounces = np.bincount([len(shot.bounces) for shot in shots]).tolist()
    with_bounces = ", ".join(f"{count} with {number}" for number, count in enumerate(bounces) if count)
    samples = np.median([shot.observed for shot in shots])
    return (
        f"{task.case}: {len(task.train)} tracks to learn from, {len(task.validation)} to judge by "
        f"(bounces: {with_bounces}); {samples:.0f} samples observed"
    )
