"""Compares the probabilities that diagnoses state for effects with the share of those effects that were planted."""

import itertools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.stats import binom

from ballfg.benchmarks.diagnosis.cases import Case, Recording
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.benchmarks.diagnosis.record import Record
from ballfg.benchmarks.diagnosis.suite import collect_records, run_case
from ballfg.benchmarks.metrics import CONFIDENCE, Figure
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.resumable import RUNS_FOLDER
from ballfg.diagnosis.hypotheses.hypothesis import TWINS

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
    runs = out / RUNS_FOLDER
    runs.mkdir(exist_ok=True)
    cases = list(reliability_cases(count, results.seed))
    add_reliability(results, cases, collect_records(cases, runs, jobs, run))


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
