"""`ballfg-bench dynamics`: every method learns from the same shots and predicts the same others."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final

import joblib
import numpy as np
import torch

from ballfg.benchmarks.dynamics_contenders import TIMED, Contender, GraphContender, Job
from ballfg.benchmarks.dynamics_fan import fan_of
from ballfg.benchmarks.dynamics_measured import measured_task
from ballfg.benchmarks.dynamics_methods import METHODS
from ballfg.benchmarks.dynamics_metrics import score_path
from ballfg.benchmarks.dynamics_record import Record, read_record, task_digest
from ballfg.benchmarks.dynamics_rows import add_rows
from ballfg.benchmarks.dynamics_task import Task
from ballfg.benchmarks.dynamics_truth import TRACKS, synthetic_task
from ballfg.benchmarks.results import Results
from ballfg.cli.progress import progress
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


FULL: Final = Plan(tracks=TRACKS, measured=None, seeds=3, quick=False)
QUICK: Final = Plan(tracks=60, measured=24, seeds=1, quick=True)


def run_dynamics(
    results: Results, dataset: Dataset | None, out: Path, plan: Plan, jobs: int, methods: Sequence[str] = tuple(METHODS)
) -> list[Path]:
    """Train, judge, and add the rows.

    Whatever is finished is kept in `out`: a run that was stopped goes on where it was.

    Args:
        results: gets the rows.
        dataset: measured tracks; None for synthetic ones.
        out: an existing folder.
        plan: how much.
        jobs: processes.
        methods: names in `METHODS`; those that need the truth are passed over on measured tracks.
    Returns: the pictures written.
    """
    from ballfg.benchmarks.dynamics_pictures import apex_picture, fan_picture, rmse_picture

    task = synthetic_task(results.seed, plan.tracks) if dataset is None else measured_task(dataset, jobs, plan.measured)
    print(describe(task))
    records = collect(task, plan, results.seed, out / RUNS_FOLDER, jobs, methods)
    for _, group in groupby(records, key=lambda record: record.method):
        add_rows(results, task.case, list(group))
    pictures = [rmse_picture(results.rows, task, out / "dynamics_rmse.png")]
    if any(row.metric.startswith("apex") for row in results.rows):
        pictures.append(apex_picture(results.rows, task, out / "dynamics_apex.png"))
    if any(record.fan is not None for record in records):
        pictures.append(fan_picture(records, task.surfaces.table_height, out / "dynamics_fan.png"))
    return pictures


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
    task: Task, plan: Plan, seed: int, folder: Path, jobs: int, methods: Sequence[str] = tuple(METHODS)
) -> list[Record]:
    """A record of each method and seed, in the order of the methods; read where it is there, made where it is not."""
    digests = {name: task_digest(task, METHODS[name].recipe(plan.quick)) for name in methods}
    folder.mkdir(parents=True, exist_ok=True)
    wanted = list(_jobs(task, plan, seed, folder, methods))
    found = {(job.method, job.seed): read_record(record_path(job), digests[job.method]) for job in wanted}
    missing = [job for job in wanted if found[job.method, job.seed] is None]
    missing.sort(key=lambda job: job.seed)  # all methods with one seed first: an early look compares them
    parallel = joblib.Parallel(n_jobs=min(jobs, max(len(missing), 1)), return_as="generator_unordered")
    made = parallel(joblib.delayed(finish)(job, digests[job.method]) for job in missing)
    for record in progress(made, len(missing), "methods and seeds finished"):
        found[record.method, record.seed] = record
    return [record for record in found.values() if record is not None]


def _jobs(task: Task, plan: Plan, seed: int, folder: Path, methods: Sequence[str]) -> Iterator[Job]:
    for name in methods:
        if task.truth is None and METHODS[name].needs_truth:
            continue
        for number in range(plan.seeds if METHODS[name].trained else 1):
            yield Job(task, name, seed + number, folder / f"{name}-{seed + number}", plan.quick)


def record_path(job: Job) -> Path:
    """Where the record of a job is kept."""
    return job.folder.with_name(job.folder.name + ".json")


def finish(job: Job, digest: str) -> Record:
    """Make a contender, judge it, keep the record."""
    torch.set_num_threads(1)  # the processes share the cores already
    record = judge(METHODS[job.method].make(job), job, digest)
    record.save(record_path(job))
    return record


def judge(contender: Contender, job: Job, digest: str) -> Record:
    """The errors of a contender on the validation tracks, and how long a prediction takes."""
    shots = job.task.validation
    seen, times = [shot.seen for shot in shots], [shot.track.times for shot in shots]
    paths = contender.predict(seen, times)
    graph = contender if isinstance(contender, GraphContender) else None
    failures = graph.failures if graph else 0
    fan = fan_of(graph) if graph and job.task.launcher is not None else None
    spent = []
    for track, stamps in zip(seen[:TIMED], times[:TIMED], strict=True):
        start = time.perf_counter()
        contender.predict([track], [stamps])
        spent.append(time.perf_counter() - start)
    return Record(
        digest=digest,
        method=job.method,
        seed=job.seed,
        parameters=contender.parameter_count,
        training_time=contender.training_seconds,
        inference_time=float(np.median(spent)),
        not_converged=failures,
        scores=tuple(score_path(shot, path) for shot, path in zip(shots, paths, strict=True)),
        fan=fan,
    )
