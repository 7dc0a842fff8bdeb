"""Runs cases and ideal tests, each in a process of its own, and keeps finished ones."""

import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from ballfg.benchmarks.diagnosis.cases import Case
from ballfg.benchmarks.diagnosis.data import declared_model, make_dataset, measured_dataset
from ballfg.benchmarks.diagnosis.ideal import Ideal, ideal_case, ideal_of
from ballfg.benchmarks.diagnosis.record import Record, case_digest, record_of
from ballfg.benchmarks.diagnosis.true_model import true_errors
from ballfg.benchmarks.resumable import Kept, collect
from ballfg.diagnosis import diagnose
from ballfg.diagnosis.result import Diagnosis

K = TypeVar("K", bound=Kept)


def run_case(case: Case, diagnose: Callable[..., Diagnosis] = diagnose) -> Record:
    """Make the data, diagnose, and fit the true model where a case asks for it."""
    digest = case_digest(case)
    with TemporaryDirectory() as folder:
        strengths: Mapping[str, float] = {}
        if case.data is None:
            dataset = make_dataset(case, Path(folder) / "tracks")
        else:
            dataset, strengths = measured_dataset(case, case.data)
        model = declared_model(case, dataset.info.ball.radius)
        start = time.perf_counter()
        diagnosis = diagnose(dataset, model, jobs=case.jobs)
        seconds = time.perf_counter() - start
        true = true_errors(case, dataset) if case.repair else None
    return replace(record_of(case, digest, diagnosis, true, seconds), strengths=strengths)


def collect_records(
    cases: Sequence[Case], folder: Path, jobs: int, run: Callable[[Case], Record] = run_case
) -> dict[str, Record]:
    """The records of cases by their names: read from an existing folder where they are there, else made and kept.

    A case whose diagnosis raises has no record: stderr reports it, it counts as failed, and the next run repeats it.
    """

    def tried(case: Case) -> Record | None:
        try:
            return run(case)
        except Exception as error:  # counted as a failure of the diagnosis: one bad case must not end a long run
            print(f"{case.name}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            return None

    found = _collect(Record, {case.name: case for case in cases}, tried, folder, jobs, "diagnoses finished")
    return {name: record for name, record in found.items() if record is not None}


def collect_ideals(
    names: Iterable[str], seed: int, folder: Path, jobs: int, compute: Callable[[Case], Ideal] = ideal_of
) -> dict[str, Ideal]:
    """The ideal tests of effects by name: read where they are there, else computed and kept."""
    cases = {f"ideal-{name}": ideal_case(name, seed) for name in names}
    found = _collect(Ideal, cases, compute, folder, jobs, "ideal tests finished")
    return {cases[name].subject: ideal for name, ideal in found.items() if ideal is not None}


def _collect(
    kind: type[K], cases: Mapping[str, Case], make: Callable[[Case], K | None], folder: Path, jobs: int, what: str
) -> dict[str, K | None]:
    """Kept parts by the names of their files without the ending."""

    def finish(name: str) -> K | None:
        made = make(cases[name])
        if made is not None:
            made.save(folder / f"{name}.json")
        return made

    def read(name: str) -> K | None:
        return kind.read(folder / f"{name}.json", case_digest(cases[name]))

    return dict(zip(cases, collect(list(cases), read, finish, jobs, what), strict=True))
