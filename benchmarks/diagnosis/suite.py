"""Runs `ballfg-bench loop`, which asks whether the diagnosis finds planted effects and no others."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from ballfg.benchmarks.diagnosis.cases import Case, Plan, all_cases, timed_cases
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.benchmarks.diagnosis.ideal import Ideal, ideal_of
from ballfg.benchmarks.diagnosis.record import Record
from ballfg.benchmarks.diagnosis.rows import add_all, detectable
from ballfg.benchmarks.diagnosis.runs import collect_ideals, collect_records, run_case
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.resumable import RUNS_FOLDER


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
