"""Runs `ballfg-bench dynamics`: every method learns from the same shots and predicts the same others.

Each is trained and judged in a process; finished ones are kept.
"""

import importlib.util
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Final, Literal

import numpy as np

from ballfg.benchmarks.dynamics import contenders
from ballfg.benchmarks.dynamics.contenders import GraphContender, Job, Record, fan_of, job_digest
from ballfg.benchmarks.dynamics.measured import Measured, measured_tasks
from ballfg.benchmarks.dynamics.task import APEXES, Task, pooled_rmse, score_path
from ballfg.benchmarks.dynamics.trained import RESIDUAL, SequenceContender, recipe, trained_contender
from ballfg.benchmarks.dynamics.truth import TRACKS, synthetic_task
from ballfg.benchmarks.metrics import Figure
from ballfg.benchmarks.results import CURVE_MARK, RUNS_FOLDER, Results, collect
from ballfg.benchmarks.speed.stopwatch import milliseconds
from ballfg.learning.run.loop import TrainingStoppedError


@dataclass(frozen=True)
class Method:
    """A row of the comparison."""

    make: Callable[[Job, Task], GraphContender | SequenceContender]
    """A contender for one of the job's tasks; what the method learns is learned at the first of them."""
    trained: bool = True  # True if a seed makes a difference; if not it runs once
    takes_part: Literal["all", "simulated", "measured"] = "all"
    """On which tracks: `all`, `simulated` or `measured` ones."""
    transfers: bool = True  # True if it can be judged on tracks of a launcher outside of its training
    package: str = ""  # required package of an extra; empty if there is none

    @property
    def installed(self) -> bool:
        """True if its required package is installed."""
        return not self.package or importlib.util.find_spec(self.package) is not None

    def fits(self, tasks: Sequence[Task]) -> bool:
        """True if it takes part on these tracks."""
        return self.takes_part in ("all", "measured" if tasks[0].truth is None else "simulated")


SEQUENCES: Final = ("lstm+aug", "diffusion+aug")
"""Methods that know the settings of their training launchers, and nothing of spin."""
TRAINED: Final = (*SEQUENCES, "a-tune+aug", "mlp+aug", "mlp+gs", "skip+gs", "mnn+gs")
"""The methods of the paper's table."""

METHODS: Final = {
    "truth": Method(contenders.truth_contender, trained=False, takes_part="simulated"),
    "nominal": Method(contenders.nominal_contender, trained=False),
    "nominal+track": Method(contenders.adapting_contender, trained=False, takes_part="measured"),
    **{
        name: Method(
            trained_contender, transfers=name not in SEQUENCES, package="diffusers" if "diffusion" in name else ""
        )
        for name in TRAINED
    },
    RESIDUAL: Method(trained_contender, takes_part="measured"),
}
"""Every method by name, in the order of the table: controls, then those that learn. `nominal+track` is the nominal
model with coefficients of each track's own, `analytic+mnn` the nominal model with a network that corrects it."""


TIMED: Final = 20  # Tracks whose predictions are timed one by one


def collect_records(
    tasks: Sequence[Task], methods: Sequence[str], seeds: Sequence[int], folder: Path, jobs: int, *, quick: bool
) -> list[list[Record]]:
    """For each task a record of each method and seed, in the order of the methods.

    They are read where they are there, and made where they are not: all methods with one seed first, so that an early
    look compares them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    listed = [
        Job(tuple(tasks), name, seed, folder / f"{name}-{seed}", quick)
        for name in methods
        if METHODS[name].fits(tasks)
        for seed in (seeds if METHODS[name].trained else seeds[:1])
    ]
    by_seed = sorted(listed, key=lambda job: job.seed)
    made = collect(by_seed, read, finish, jobs, "methods and seeds finished")
    finished = {job.folder: records for job, records in zip(by_seed, made, strict=True)}
    every = [finished[job.folder] or {} for job in listed]
    return [[records[k] for records in every if k in records] for k in range(len(tasks))]


def judged(job: Job) -> list[int]:
    """The numbers of the tasks that a job's method can be judged on."""
    return [k for k, task in enumerate(job.tasks) if task.train or METHODS[job.method].transfers]


def record_path(job: Job, number: int) -> Path:
    """Path of the record of a job on one of its tasks."""
    ending = "" if len(job.tasks) == 1 else f"-on-{number}"
    return job.folder.with_name(f"{job.folder.name}{ending}.json")


def _digest(job: Job, number: int) -> str:
    how = recipe(job) if METHODS[job.method].trained else "untrained"
    return job_digest(job.tasks[number], job.tasks, how)


def read(job: Job) -> dict[int, Record] | None:
    """The records of a finished job by the numbers of its tasks; None if one is missing."""
    records = {k: Record.read(record_path(job, k), _digest(job, k)) for k in judged(job)}
    whole = {k: record for k, record in records.items() if record is not None}
    return whole if len(whole) == len(records) else None


def finish(job: Job) -> dict[int, Record]:
    """Make a method's contenders, judge them, and keep the records.

    If its training fails, it has no records, and the other methods are still compared.
    """
    records = {}
    for k in judged(job):
        try:
            contender = METHODS[job.method].make(job, job.tasks[k])
        except TrainingStoppedError as error:
            print(f"note: {job.method}, seed {job.seed}, is left out: {error}", file=sys.stderr, flush=True)
            break
        records[k] = judge(contender, job, k)
        records[k].save(record_path(job, k))
    return records


def judge(contender: GraphContender | SequenceContender, job: Job, number: int) -> Record:
    """The errors of a contender on the validation tracks of a task, and how long a prediction takes."""
    task = job.tasks[number]
    shots = task.validation
    seen, times = [shot.seen for shot in shots], [shot.track.times for shot in shots]
    paths = contender.predict(seen, times)
    graph = contender if isinstance(contender, GraphContender) else None
    timed = zip(seen[:TIMED], times[:TIMED], strict=True)
    spent = [milliseconds(partial(contender.predict, [track], [stamps])) for track, stamps in timed]
    return Record(
        digest=_digest(job, number),
        method=job.method,
        seed=job.seed,
        parameters=contender.parameter_count,
        training_time=contender.training_seconds,
        inference_time=1e-3 * float(np.median(spent)),
        not_converged=graph.failures if graph else 0,
        scores=tuple(score_path(shot, path) for shot, path in zip(shots, paths, strict=True)),
        fan=fan_of(graph) if graph and task.launcher is not None else None,
    )


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
