"""Runs `ballfg-bench loop`, which asks whether the diagnosis finds planted effects and no others."""

import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from ballfg.benchmarks.diagnosis.cases import Case, Plan, all_cases, timed_cases
from ballfg.benchmarks.diagnosis.data import declared_model, make_dataset, measured_dataset, true_errors
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.benchmarks.diagnosis.ideal import Ideal, ideal_case, ideal_of
from ballfg.benchmarks.diagnosis.record import Record, case_digest, record_of
from ballfg.benchmarks.diagnosis.rows import add_all, detectable
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.resumable import RUNS_FOLDER, Kept, collect
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


def run_loop(
    results: Results,
    data: Sequence[Path],
    out: Path,
    plan: Plan,
    jobs: int,
    run: Callable[[Case], Record] = run_case,
    ideal: Callable[[Case], Ideal] = ideal_of,
) -> list[Path]:
    """Plant, diagnose, judge, and add the rows. Finished cases are kept: a run that was stopped goes on where it was.

    Args: data: folders of measured tracks, for the part that needs some.  out: an existing folder.
    Returns: the pictures written.
    """
    from ballfg.benchmarks.diagnosis.pictures import confusion_picture, power_picture, repair_picture

    folder = out / RUNS_FOLDER
    folder.mkdir(exist_ok=True)
    if not data:
        print("note: no --data: nothing measured is diagnosed", file=sys.stderr)
    ideals = collect_ideals([n for n in plan.effects if PLANTS[n].sized], results.seed, folder, jobs, ideal)
    cases = all_cases(plan, results.seed, detectable(ideals), data)
    records = collect_records(cases, folder, jobs, run)
    timed = list(timed_cases(plan, results.seed))
    records |= collect_records(timed, folder, 1, run)  # alone, one after the other
    add_all(results, [*cases, *timed], records, ideals)
    return [
        power_picture(cases, records, ideals, out / "loop_power.png"),
        confusion_picture(cases, records, out / "loop_first_finding.png"),
        repair_picture(results.rows, out / "loop_repair.png"),
    ]
