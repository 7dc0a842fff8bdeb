"""Runs `ballfg-bench loop`, which asks whether the diagnosis finds planted effects and no others, and how surely."""

import itertools
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.stats import binom

from ballfg.benchmarks.diagnosis.cases import PLANTS, Case, Plan, Recording, all_cases, timed_cases
from ballfg.benchmarks.diagnosis.data import declared_model, make_dataset, measured_dataset, true_errors
from ballfg.benchmarks.diagnosis.record import Record, case_digest, record_of
from ballfg.benchmarks.diagnosis.rows import add_all
from ballfg.benchmarks.metrics import CONFIDENCE, Figure
from ballfg.benchmarks.results import RUNS_FOLDER, Results, collect
from ballfg.diagnosis import diagnose
from ballfg.diagnosis.hypotheses.hypothesis import TWINS
from ballfg.diagnosis.result import Diagnosis


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
    cases: Sequence[Case], out: Path, jobs: int, run: Callable[[Case], Record] = run_case
) -> dict[str, Record]:
    """The records of cases by their names: read from `out`, an existing folder, where they are, else made and kept.

    A case whose diagnosis raises has no record: stderr reports it, it counts as failed, and the next run repeats it.
    """
    folder, by_name = out / RUNS_FOLDER, {case.name: case for case in cases}
    folder.mkdir(exist_ok=True)

    def finish(name: str) -> Record | None:
        try:
            record = run(by_name[name])
        except Exception as error:  # counted as a failure of the diagnosis: one bad case must not end a long run
            print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            return None
        record.save(folder / f"{name}.json")
        return record

    def read(name: str) -> Record | None:
        return Record.read(folder / f"{name}.json", case_digest(by_name[name]))

    found = zip(by_name, collect(list(by_name), read, finish, jobs, "diagnoses finished"), strict=True)
    return {name: record for name, record in found if record is not None}


def run_loop(
    results: Results,
    data: Sequence[Path],
    out: Path,
    plan: Plan,
    jobs: int,
    run: Callable[[Case], Record] = run_case,
) -> list[Path]:
    """Plant, diagnose, judge, and add the rows. Finished cases are kept: a run that was stopped goes on where it was.

    Args: data: folders of measured tracks, for the part that needs some.  out: an existing folder.
    Returns: the pictures written.
    """
    from ballfg.benchmarks.diagnosis.pictures import confusion_picture, repair_picture

    if not data:
        print("note: no --data: nothing measured is diagnosed", file=sys.stderr)
    cases = all_cases(plan, results.seed, data)
    records = collect_records(cases, out, jobs, run)
    timed = list(timed_cases(plan, results.seed))
    records |= collect_records(timed, out, 1, run)  # alone, one after the other
    add_all(results, [*cases, *timed], records)
    return [
        confusion_picture(cases, records, out / "loop_first_finding.png"),
        repair_picture(results.rows, out / "loop_repair.png"),
    ]


TITLE, ALL = "reliability", "all"
EDGES = (0.5, 0.7, 0.9, 0.97, 1.0)  # Ends of the bins of the stated probability; a bin holds its lower end
MOST_PLANTED = 3
SMALLEST, LARGEST = 0.2, 5.0  # Sizes over the usual one, between which their logarithms are uniform
LABELLED = 0.5  # Share of the sets with spin labels


def reliability_cases(count: int, seed: int) -> Iterator[Case]:
    """Sets with up to three effects each, of sizes drawn independently."""
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        labels = bool(rng.random() < LABELLED)
        lacked = [plant for plant in PLANTS.values() if plant.sized and not plant.left_out]
        offered = [plant for plant in lacked if labels or not plant.name.startswith("spin_label")]
        chosen = rng.choice(len(offered), rng.integers(MOST_PLANTED + 1), replace=False)
        plants = [offered[place] for place in chosen.tolist()]
        sizes = np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST), len(plants))).tolist()
        texts = tuple(text for plant, size in zip(plants, sizes, strict=True) for text in plant.texts(size))
        names = tuple(plant.name for plant in plants)
        yield Case(TITLE, f"set-{seed}", 1.0, number, names, sessions=(texts,), recording=Recording(labels=labels))


def run_reliability(
    results: Results, out: Path, count: int, jobs: int, run: Callable[[Case], Record] = run_case
) -> None:
    """Simulate, diagnose, and add the rows; finished sets are kept in `out`, an existing folder."""
    cases = list(reliability_cases(count, results.seed))
    add_reliability(results, cases, collect_records(cases, out, jobs, run))


def _right(case: Case) -> set[str]:
    """The planted effects, and the equivalent ones: less gravity is a buoyancy."""
    return set(case.planted) | {name for name, twins in TWINS.items() if set(twins) & set(case.planted)}


def add_reliability(results: Results, cases: Sequence[Case], records: Mapping[str, Record]) -> None:
    """In each bin the mean stated probability, and the share of right names with the band that chance allows about it.

    The calibration error is the mean distance of both over the bins, weighted with the number of names. A set whose
    diagnosis failed counts apart.
    """
    done = [(case, records[case.name]) for case in cases if case.name in records]
    results.add(TITLE, "failed", ALL, "1", float(len(cases) - len(done)), len(cases))
    stated = [(p, name in _right(case)) for case, record in done for name, p in record.probabilities.items()]
    if not stated:
        print("note: no reliability rows: the diagnoses state no probability", file=sys.stderr)
        return
    probabilities, right = (np.array(column, dtype=np.float64) for column in zip(*stated, strict=True))
    bins, distances = np.digitize(probabilities, EDGES[1:-1]), []
    for place, (low, high) in enumerate(itertools.pairwise(EDGES)):
        own = (bins == place) & (probabilities >= EDGES[0])
        if not own.any():
            continue
        mean, number, line = float(probabilities[own].mean()), int(own.sum()), f"{100 * low:g}-{100 * high:g} %"
        band = np.asarray(binom.interval(CONFIDENCE, number, mean)) / number
        share = float(right[own].mean())
        results.add(TITLE, "stated probability", line, "1", mean, number)
        results.add(TITLE, "share right [chance allows]", line, "1", Figure(share, *map(float, band)), number)
        distances.append((number, abs(share - mean)))
    if distances:
        weights, errors = zip(*distances, strict=True)
        results.add(TITLE, "calibration error", ALL, "1", float(np.average(errors, weights=weights)), sum(weights))
