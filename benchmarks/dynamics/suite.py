"""Runs `ballfg-bench dynamics`: every method learns from the same shots and predicts the same others."""

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.benchmarks.dynamics.jobs import collect_records
from ballfg.benchmarks.dynamics.measured import Measured, measured_tasks
from ballfg.benchmarks.dynamics.methods import METHODS
from ballfg.benchmarks.dynamics.rows import add_rows
from ballfg.benchmarks.dynamics.task import Task
from ballfg.benchmarks.dynamics.truth import TRACKS, synthetic_task
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.resumable import RUNS_FOLDER


@dataclass(frozen=True)
class Plan:
    """The amount of computation.

    Attributes:
        tracks: synthetic ones.  measured: measured tracks at most; None for all.
        seeds: how often each trained method is trained.  quick: train just enough to see that everything works.
    """

    tracks: int
    measured: int | None
    seeds: int
    quick: bool


FULL: Final = Plan(tracks=TRACKS, measured=None, seeds=3, quick=False)
QUICK: Final = Plan(tracks=60, measured=24, seeds=1, quick=True)


def run_dynamics(
    results: Results, data: Measured | None, out: Path, plan: Plan, jobs: int, methods: Sequence[str] | None = None
) -> list[Path]:
    """Train, judge, and add the rows. Finished methods are kept in `out`: a run that was stopped goes on where it was.

    Args: methods: names in `METHODS`, None for all; those that do not take part on such tracks are passed over.
    Returns: the pictures written.
    Raises: ValueError: if a method's name is unknown.
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
    """The methods to compare; of all of them those that are installed.

    Raises: ValueError: if one that was asked for needs a package that is not there.
    """
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
