"""Lists the methods of the dynamics comparison, trains and judges each in a process, and keeps finished ones."""

import importlib.util
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Literal

import numpy as np

from ballfg.benchmarks.dynamics import contenders
from ballfg.benchmarks.dynamics.contenders import Contender, GraphContender, Job, Record, fan_of, job_digest
from ballfg.benchmarks.dynamics.task import Task, score_path
from ballfg.benchmarks.dynamics.trained import RESIDUAL, recipe, trained_contender
from ballfg.benchmarks.results import collect
from ballfg.benchmarks.speed.stopwatch import milliseconds
from ballfg.learning.run.loop import TrainingStoppedError


@dataclass(frozen=True)
class Method:
    """A row of the comparison."""

    make: Callable[[Job, Task], Contender]
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


def judge(contender: Contender, job: Job, number: int) -> Record:
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
