"""`ballfg-bench dynamics`: every method learns from the same shots and predicts the same others."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final

import joblib
import numpy as np
import torch

from ballfg.benchmarks.dynamics.contenders import TIMED, Contender, GraphContender, Job
from ballfg.benchmarks.dynamics.fan import fan_of
from ballfg.benchmarks.dynamics.measured import measured_tasks
from ballfg.benchmarks.dynamics.methods import METHODS
from ballfg.benchmarks.dynamics.metrics import score_path
from ballfg.benchmarks.dynamics.record import Record, job_digest, read_record
from ballfg.benchmarks.dynamics.rows import add_rows
from ballfg.benchmarks.dynamics.task import Task
from ballfg.benchmarks.dynamics.truth import TRACKS, synthetic_task
from ballfg.benchmarks.results import Results
from ballfg.learning.run.loop import TrainingStoppedError
from ballfg.progress import progress
from ballfg.tracks import Dataset

RUNS_FOLDER: Final = "runs"
"""In the output folder: one JSON and one folder for each method and seed."""


@dataclass(frozen=True)
class Plan:
    """How much is computed.

    Attributes:
        tracks: synthetic ones.
        measured: measured tracks at most; None for all.
        seeds: how often each trained method is trained.
        quick: train just enough to see that everything works.
    """

    tracks: int
    measured: int | None
    seeds: int
    quick: bool


@dataclass(frozen=True)
class Measured:
    """Measured tracks.

    Attributes:
        datasets: one model learns from all of them; it is judged on each.
        transfer: the models are judged on it, but learn nothing from it; None for none.
        transfer_tracks: how many of its first tracks; None for all.
    """

    datasets: Sequence[Dataset]
    transfer: Dataset | None = None
    transfer_tracks: int | None = None


FULL: Final = Plan(tracks=TRACKS, measured=None, seeds=3, quick=False)
QUICK: Final = Plan(tracks=60, measured=24, seeds=1, quick=True)


def run_dynamics(
    results: Results, data: Measured | None, out: Path, plan: Plan, jobs: int, methods: Sequence[str] = tuple(METHODS)
) -> list[Path]:
    """Train, judge, and add the rows.

    Whatever is finished is kept in `out`: a run that was stopped goes on where it was.

    Args:
        results: gets the rows.
        data: measured tracks; None for synthetic ones.
        out: an existing folder.
        plan: how much.
        jobs: processes.
        methods: names in `METHODS`; those that do not take part on such tracks are passed over.
    Returns: the pictures written.
    """
    from ballfg.benchmarks.dynamics.pictures import apex_picture, fan_picture, rmse_picture

    tasks = _tasks(results.seed, data, plan, jobs)
    for task in tasks:
        print(describe(task))
    pictures = []
    for task, records in zip(tasks, collect(tasks, plan, results.seed, out / RUNS_FOLDER, jobs, methods), strict=True):
        for _, group in groupby(records, key=lambda record: record.method):
            add_rows(results, task, list(group))
        ending = "" if len(tasks) == 1 else "_" + re.sub(r"\W+", "_", task.case)
        pictures.append(rmse_picture(results.rows, task, out / f"dynamics_rmse{ending}.png"))
        if any(row.metric.startswith("apex") for row in results.rows if row.case == task.case):
            pictures.append(apex_picture(results.rows, task, out / f"dynamics_apex{ending}.png"))
        if any(record.fan is not None for record in records):
            pictures.append(fan_picture(records, task.surfaces.table_height, out / f"dynamics_fan{ending}.png"))
    return pictures


def _tasks(seed: int, data: Measured | None, plan: Plan, jobs: int) -> list[Task]:
    if data is None:
        return [synthetic_task(seed, plan.tracks)]
    transfer_tracks = min(data.transfer_tracks or sys.maxsize, plan.measured or sys.maxsize)
    return measured_tasks(data.datasets, data.transfer, jobs, plan.measured, transfer_tracks)


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


def collect(
    tasks: Sequence[Task], plan: Plan, seed: int, folder: Path, jobs: int, methods: Sequence[str] = tuple(METHODS)
) -> list[list[Record]]:
    """For each task a record of each method and seed, in the order of the methods.

    They are read where they are there, and made where they are not.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = list(_jobs(tuple(tasks), plan, seed, folder, methods))
    found = {(job.method, job.seed): read(job) for job in wanted}
    missing = [job for job in wanted if found[job.method, job.seed] is None]
    missing.sort(key=lambda job: job.seed)  # all methods with one seed first: an early look compares them
    parallel = joblib.Parallel(n_jobs=min(jobs, max(len(missing), 1)), return_as="generator_unordered")
    made = parallel(joblib.delayed(finish)(job) for job in missing)
    for (method, number), records in progress(made, len(missing), "methods and seeds finished"):
        found[method, number] = records
    finished = [records for records in found.values() if records is not None]
    return [[records[k] for records in finished if k in records] for k in range(len(tasks))]


def _jobs(tasks: tuple[Task, ...], plan: Plan, seed: int, folder: Path, methods: Sequence[str]) -> Iterator[Job]:
    for name in methods:
        if not METHODS[name].fits(tasks):
            continue
        for number in range(plan.seeds if METHODS[name].trained else 1):
            yield Job(tasks, name, seed + number, folder / f"{name}-{seed + number}", plan.quick)


def judged(job: Job) -> list[int]:
    """The numbers of the tasks that a job's method can be judged on."""
    return [k for k, task in enumerate(job.tasks) if task.train or METHODS[job.method].transfers]


def record_path(job: Job, number: int) -> Path:
    """Where the record of a job on one of its tasks is kept."""
    ending = "" if len(job.tasks) == 1 else f"-on-{number}"
    return job.folder.with_name(f"{job.folder.name}{ending}.json")


def read(job: Job) -> dict[int, Record] | None:
    """The records of a finished job by the numbers of its tasks; None if one is missing."""
    records = {k: read_record(record_path(job, k), _digest(job, k)) for k in judged(job)}
    whole = {k: record for k, record in records.items() if record is not None}
    return whole if len(whole) == len(records) else None


def finish(job: Job) -> tuple[tuple[str, int], dict[int, Record]]:
    """Make a method's contenders, judge them, keep the records; with the method and its seed.

    Without any record where its training does not get through: the others are compared all the same.
    """
    torch.set_num_threads(1)  # the processes share the cores already
    records = {}
    for k in judged(job):
        try:
            contender = METHODS[job.method].make(job, job.tasks[k])
        except TrainingStoppedError as error:
            print(f"note: {job.method}, seed {job.seed}, is left out: {error}", file=sys.stderr)
            break
        records[k] = judge(contender, job, k)
        records[k].save(record_path(job, k))
    return (job.method, job.seed), records


def _digest(job: Job, number: int) -> str:
    return job_digest(job.tasks[number], job.tasks, METHODS[job.method].recipe(job))


def judge(contender: Contender, job: Job, number: int) -> Record:
    """The errors of a contender on the validation tracks of a task, and how long a prediction takes."""
    task = job.tasks[number]
    shots = task.validation
    seen, times = [shot.seen for shot in shots], [shot.track.times for shot in shots]
    paths = contender.predict(seen, times)
    graph = contender if isinstance(contender, GraphContender) else None
    failures = graph.failures if graph else 0
    fan = fan_of(graph) if graph and task.launcher is not None else None
    spent = []
    for track, stamps in zip(seen[:TIMED], times[:TIMED], strict=True):
        start = time.perf_counter()
        contender.predict([track], [stamps])
        spent.append(time.perf_counter() - start)
    return Record(
        digest=_digest(job, number),
        method=job.method,
        seed=job.seed,
        parameters=contender.parameter_count,
        training_time=contender.training_seconds,
        inference_time=float(np.median(spent)),
        not_converged=failures,
        scores=tuple(score_path(shot, path) for shot, path in zip(shots, paths, strict=True)),
        fan=fan,
    )
