"""Running the cases: each in a process of its own, its record kept, so that a run that was stopped goes on."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import joblib
import torch

from ballfg.benchmarks.diagnosis.cases import Case
from ballfg.benchmarks.diagnosis.data import declared_model, make_dataset
from ballfg.benchmarks.diagnosis.ideal import Ideal, ideal_case, ideal_of, read_ideal, save_ideal
from ballfg.benchmarks.diagnosis.record import Record, case_digest, read_record, record_of
from ballfg.benchmarks.diagnosis.truth import true_errors
from ballfg.diagnosis import diagnose
from ballfg.progress import progress
from ballfg.tracks import read_dataset

T = TypeVar("T")
R = TypeVar("R")


def collect(cases: Sequence[Case], folder: Path, jobs: int) -> dict[str, Record]:
    """The records of cases by their names: read where they are there, made where they are not.

    A case whose diagnosis raises has no record: it is told on stderr, counts as failed, and is tried again by the next
    run.

    Args: folder: of the records; it exists.  jobs: processes.
    """
    found = {case.name: read_record(folder / f"{case.name}.json", case_digest(case)) for case in cases}
    missing = [case for case in cases if found[case.name] is None]
    for name, record in _parallel(_finish, missing, folder, jobs, "diagnoses finished"):
        if isinstance(record, str):
            print(f"{name}: {record}", file=sys.stderr, flush=True)
        else:
            found[name] = record
    return {name: record for name, record in found.items() if record is not None}


def collect_ideals(names: Sequence[str], seed: int, folder: Path, jobs: int) -> dict[str, Ideal]:
    """The ideal tests of effects by name: read where they are there, made where they are not."""
    found = {name: read_ideal(_ideal_path(folder, name), case_digest(ideal_case(name, seed))) for name in names}
    missing = [(name, seed) for name in names if found[name] is None]
    for name, ideal in _parallel(_finish_ideal, missing, folder, jobs, "ideal tests finished"):
        found[name] = ideal
    return {name: ideal for name, ideal in found.items() if ideal is not None}


def run(case: Case) -> Record:
    """Make the data, diagnose, and fit the true model where a case asks for it."""
    digest = case_digest(case)
    with TemporaryDirectory() as folder:
        dataset = make_dataset(case, Path(folder) / "tracks") if case.data is None else read_dataset(case.data)
        model = declared_model(case, dataset.info.ball.radius)
        start = time.perf_counter()
        diagnosis = diagnose(dataset, model, jobs=case.jobs)
        seconds = time.perf_counter() - start
        true = true_errors(case, dataset) if case.repair else None
    return record_of(case, digest, diagnosis, true, seconds)


def _finish(case: Case, folder: Path) -> tuple[str, Record | str]:
    """Run a case and keep its record; in place of a record the error that stopped it."""
    torch.set_num_threads(1)  # the processes share the cores already
    try:
        record = run(case)
    except Exception as error:  # counted as a failure of the diagnosis: one bad case must not end a long run
        return case.name, f"{type(error).__name__}: {error}"
    record.save(folder / f"{case.name}.json")
    return case.name, record


def _finish_ideal(wanted: tuple[str, int], folder: Path) -> tuple[str, Ideal]:
    torch.set_num_threads(1)
    name, seed = wanted
    ideal = ideal_of(name, seed)
    save_ideal(ideal, _ideal_path(folder, name))
    return name, ideal


def _ideal_path(folder: Path, name: str) -> Path:
    return folder / f"ideal-{name}.json"


def _parallel(work: Callable[[T, Path], R], items: Sequence[T], folder: Path, jobs: int, what: str) -> Iterable[R]:
    pool = joblib.Parallel(n_jobs=min(jobs, max(len(items), 1)), return_as="generator_unordered")
    return progress(pool(joblib.delayed(work)(item, folder) for item in items), len(items), what)
