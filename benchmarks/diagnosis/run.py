"""`ballfg-bench loop`: does the diagnosis find what was planted, stay silent where nothing was, and mend the model?"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ballfg.benchmarks.diagnosis.cases import (
    FULL,
    QUICK,
    Case,
    Plan,
    detection_cases,
    measured_cases,
    naming_cases,
    null_cases,
    timed_cases,
    unknown_cases,
)
from ballfg.benchmarks.diagnosis.cases_run import collect, collect_ideals
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.benchmarks.diagnosis.ideal import Ideal
from ballfg.benchmarks.diagnosis.record import Record
from ballfg.benchmarks.diagnosis.rows import (
    add_detection,
    add_measured,
    add_naming,
    add_pairs,
    add_repair,
    add_silence,
    add_time,
    add_unknown,
    detectable,
)
from ballfg.benchmarks.results import Results

__all__ = ["FULL", "QUICK", "run_loop"]

RUNS_FOLDER: Final = "runs"
"""In the output folder: one JSON file for each case."""


def run_loop(results: Results, data: Sequence[Path], out: Path, plan: Plan, jobs: int) -> list[Path]:
    """Plant, diagnose, judge, and add the rows.

    Whatever is finished is kept in `out`: a run that was stopped goes on where it was.

    Args:
        results: gets the rows.
        data: folders of measured tracks, for the part that needs some.
        out: an existing folder.
        plan: how much.
        jobs: processes.
    Returns: the pictures written.
    """
    from ballfg.benchmarks.diagnosis.pictures import confusion_picture, power_picture, repair_picture

    folder = out / RUNS_FOLDER
    folder.mkdir(exist_ok=True)
    if not data:
        print("note: no --data: nothing measured is diagnosed", file=sys.stderr)
    ideals = collect_ideals([n for n in plan.effects if PLANTS[n].sized], results.seed, folder, jobs)
    cases = all_cases(plan, results.seed, ideals, data)
    records = collect(cases, folder, jobs)
    timed = list(timed_cases(plan, results.seed))
    records |= collect(timed, folder, 1)  # alone, one after the other
    add_all(results, [*cases, *timed], records, ideals)
    return [
        power_picture(cases, records, ideals, out / "loop_power.png"),
        confusion_picture(cases, records, out / "loop_first_finding.png"),
        repair_picture(results.rows, out / "loop_repair.png"),
    ]


def all_cases(plan: Plan, seed: int, ideals: dict[str, Ideal], data: Sequence[Path]) -> list[Case]:
    """Everything that may run side by side, parts evenly mixed: an early look sees something of all."""
    parts = [
        list(measured_cases(data)),
        list(naming_cases(plan, seed)),
        list(null_cases(plan, seed)),
        list(unknown_cases(plan, seed)),
        list(detection_cases(plan, seed, detectable(ideals))),
    ]
    placed = [(number / len(part), case) for part in parts for number, case in enumerate(part)]
    return [case for _, case in sorted(placed, key=lambda pair: pair[0])]


def add_all(results: Results, cases: Sequence[Case], records: dict[str, Record], ideals: dict[str, Ideal]) -> None:
    """The rows of every part."""
    add_naming(results, cases, records, "naming", "naming, spin labels")
    add_naming(results, cases, records, "no_labels", "naming, no spin labels")
    add_pairs(results, cases, records)
    add_detection(results, cases, records, ideals)
    add_silence(results, cases, records)
    add_repair(results, cases, records)
    add_unknown(results, cases, records)
    add_measured(results, cases, records)
    add_time(results, cases, records)
