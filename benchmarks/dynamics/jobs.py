"""Trains and judges the methods of the dynamics comparison, each in a process, and keeps finished ones."""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.benchmarks.dynamics.contenders import Contender, GraphContender, Job
from ballfg.benchmarks.dynamics.fan import fan_of
from ballfg.benchmarks.dynamics.methods import METHODS
from ballfg.benchmarks.dynamics.record import Record, job_digest
from ballfg.benchmarks.dynamics.task import Task, score_path
from ballfg.benchmarks.dynamics.trained import recipe
from ballfg.benchmarks.resumable import collect
from ballfg.benchmarks.speed.stopwatch import milliseconds
from ballfg.learning.run.loop import TrainingStoppedError

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


def judge(contender: Contender, job: Job, number: int) -> Record:
    """The errors of a contender on the validation tracks of a task, and how long a prediction takes."""
    task = job.tasks[number]
    shots = task.validation
    seen, times = [shot.seen for shot in shots], [shot.track.times for shot in shots]
    paths = contender.predict(seen, times)
    graph = contender if isinstance(contender, GraphContender) else None
    failures = graph.failures if graph else 0
    timed = zip(seen[:TIMED], times[:TIMED], strict=True)
    spent = [milliseconds(partial(contender.predict, [track], [stamps])) for track, stamps in timed]
    return Record(
        digest=_digest(job, number),
        method=job.method,
        seed=job.seed,
        parameters=contender.parameter_count,
        training_time=contender.training_seconds,
        inference_time=1e-3 * float(np.median(spent)),
        not_converged=failures,
        scores=tuple(score_path(shot, path) for shot, path in zip(shots, paths, strict=True)),
        fan=fan_of(graph) if graph and task.launcher is not None else None,
    )
