"""Rows of results from the records of the loop's cases; docs/benchmarks_loop.md says what each metric is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ballfg.benchmarks.diagnosis.cases import BARE, STATED_NOISE, Case
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.benchmarks.diagnosis.ideal import Ideal
from ballfg.benchmarks.diagnosis.limit import Curve, median, power_curve, share
from ballfg.benchmarks.diagnosis.record import Record
from ballfg.benchmarks.diagnosis.verdicts import alarmed, complete, named, right
from ballfg.benchmarks.results import Results
from ballfg.diagnosis.result import Verdict

ALL = "all"
HIDDEN = "all that hide"
"""Rows over the effects that have equals; `ALL` is over the others."""
FAILED = "failed"
"""How many cases of a part ended in an error; they count as wrong."""
LARGEST_IDEAL = 2.0
"""Times its typical size. An effect for which the ideal test needs more is not looked for at its limit."""
FEW_TRACKS = 25
"""Null datasets of so many tracks are also counted apart."""

Records = Mapping[str, Record]


def of_part(cases: Sequence[Case], part: str) -> list[Case]:
    """The cases of a part."""
    return [case for case in cases if case.part == part]


def add_naming(results: Results, cases: Sequence[Case], records: Records, part: str, title: str) -> None:
    """Share named right, a line an effect and a column a size; then over all effects, those that hide apart."""
    listed = of_part(cases, part)
    for subject in dict.fromkeys(case.subject for case in listed):
        for size in dict.fromkeys(case.size for case in listed if case.subject == subject):
            outcomes = [_right(case, records) for case in listed if (case.subject, case.size) == (subject, size)]
            results.add(title, _column(size), subject, "1", share(outcomes), len(outcomes))
    for line, hidden in ((ALL, False), (HIDDEN, True)):
        for size in dict.fromkeys(case.size for case in listed):
            chosen = [case for case in listed if case.size == size and _hides(case) is hidden]
            if chosen:
                outcomes = [_right(case, records) for case in chosen]
                results.add(title, _column(size), line, "1", share(outcomes), len(outcomes))
    _add_failed(results, listed, records, title)


def add_pairs(results: Results, cases: Sequence[Case], records: Records) -> None:
    """For two effects at once: is the first finding one of them, are both found and nothing else?"""
    listed = of_part(cases, "pairs")
    for line, chosen in _lines(listed).items():
        first = [_right(case, records) for case in chosen]
        both = [case.name in records and complete(records[case.name], case.planted) for case in chosen]
        results.add("pairs", "first", line, "1", share(first), len(chosen))
        results.add("pairs", "both", line, "1", share(both), len(chosen))
    _add_failed(results, listed, records, "pairs")


def detectable(ideals: Mapping[str, Ideal]) -> dict[str, float]:
    """The ideal test's size of the effects that are looked for at their limit."""
    return {name: ideal.size for name, ideal in ideals.items() if ideal.size <= LARGEST_IDEAL}


def power_curves(
    cases: Sequence[Case], records: Records, ideals: Mapping[str, Ideal]
) -> dict[str, tuple[list[float], list[bool], Curve]]:
    """By effect: the sizes tried, whether each was named, and the curve through them."""
    curves = {}
    listed = [case for part in ("naming", "detection") for case in of_part(cases, part)]
    for name in ideals:
        own = [case for case in listed if case.subject == name]
        sizes = [case.size for case in own]
        outcomes = [case.name in records and named(records[case.name], case.planted) for case in own]
        curves[name] = (sizes, outcomes, power_curve(sizes, outcomes))
    return curves


def add_detection(results: Results, cases: Sequence[Case], records: Records, ideals: Mapping[str, Ideal]) -> None:
    """The size that the ideal test needs, the one that the loop needs, in typical sizes, and their ratio."""
    title, ratios = "detection limit", []
    curves = power_curves(cases, records, ideals)
    for name, ideal in ideals.items():
        results.add(title, "ideal", name, "1", ideal.size, 1)
        if name in detectable(ideals) and any(case.subject == name for case in of_part(cases, "detection")):
            sizes, _, curve = curves[name]
            ratios.append(curve.limit / ideal.size)
            results.add(title, "loop", name, "1", curve.limit, len(sizes))
            results.add(title, "loop / ideal", name, "1", ratios[-1], len(sizes))
    if ratios:
        results.add(title, "loop / ideal", "median", "1", median(ratios), len(ratios))
    _add_failed(results, of_part(cases, "detection"), records, title)


def add_silence(results: Results, cases: Sequence[Case], records: Records) -> None:
    """False alarms: an effect named, and any verdict but that nothing is lacking; over all, and by kind of data."""
    listed = of_part(cases, "silence")
    for line, chosen in _kinds(listed).items():
        done = [records.get(case.name) for case in chosen]
        by_name = [record is None or bool(record.found) for record in done]
        any_alarm = [record is None or alarmed(record) for record in done]
        for column, outcomes in (("effect named", by_name), ("any alarm", any_alarm)):
            if outcomes:
                results.add("silence", column, line, "1", share(outcomes), len(outcomes))
    _add_failed(results, listed, records, "silence")


def _kinds(cases: Sequence[Case]) -> dict[str, list[Case]]:
    """Null datasets by what is special about them."""
    taken = {case.name: case.recording for case in cases}
    return {
        ALL: list(cases),
        "noise larger than stated": [c for c in cases if taken[c.name].position > STATED_NOISE],
        "noise smaller than stated": [c for c in cases if taken[c.name].position <= STATED_NOISE],
        "spin labels": [c for c in cases if taken[c.name].labels],
        "no spin labels": [c for c in cases if not taken[c.name].labels],
        "few launcher settings": [c for c in cases if taken[c.name].levels],
        f"at most {FEW_TRACKS} tracks": [c for c in cases if taken[c.name].tracks <= FEW_TRACKS],
    }


def add_repair(results: Results, cases: Sequence[Case], records: Records) -> None:
    """Prediction error with the corrected and with the declared model, over that of the true one; seeds' median."""
    every: dict[str, list[float]] = {"after / true": [], "before / true": []}
    listed = [case for case in cases if case.repair and case.name in records]
    for subject in dict.fromkeys(case.subject for case in listed):
        own = [records[case.name].errors for case in listed if case.subject == subject]
        for column, which in (("after / true", "after"), ("before / true", "before")):
            ratios = [errors[which] / errors["true"] for errors in own]
            every[column] += ratios
            results.add("repair", column, subject, "1", median(ratios), len(ratios))
    for column, ratios in every.items():
        if ratios:
            results.add("repair", column, ALL, "1", median(ratios), len(ratios))


def add_unknown(results: Results, cases: Sequence[Case], records: Records) -> None:
    """Physics of no catalogue: called unexplained, error reduced by the fallback, both, and by how much."""
    listed = of_part(cases, "unknown")
    title = "unknown physics"
    for line, own in _lines(listed).items():
        done = [records.get(case.name) for case in own]
        called = [r is not None and r.verdict == Verdict.UNEXPLAINED.value for r in done]
        reduced = [r is not None and "fallback" in r.errors and r.errors["fallback"] < r.errors["named"] for r in done]
        both = [c and r for c, r in zip(called, reduced, strict=True)]
        for column, outcomes in (("unexplained", called), ("reduced", reduced), ("both", both)):
            results.add(title, column, line, "1", share(outcomes), len(own))
        ratios = [r.errors["fallback"] / r.errors["named"] for r in done if r is not None and "fallback" in r.errors]
        if ratios:
            results.add(title, "error with / without fallback", line, "1", median(ratios), len(ratios))
    _add_failed(results, listed, records, title)


def add_measured(results: Results, cases: Sequence[Case], records: Records) -> None:
    """Each measured dataset: errors before and after, and each finding with its BIC difference."""
    for case in of_part(cases, "measured"):
        if case.name not in records:
            continue
        record, column = records[case.name], "bare model" if case.planted == BARE else "nominal model"
        title = case.subject.removesuffix("-bare")
        for which in ("before", "after", "fallback"):
            if which in record.errors:
                results.add(title, column, f"prediction_rmse_{which}", "mm", record.errors[which], record.judged)
        ratio = record.errors["after"] / record.errors["before"]
        results.add(title, column, "after / before", "1", ratio, record.judged)
        for place, found in enumerate(record.found, start=1):
            results.add(
                title, column, f"delta_bic of finding {place}, {found.name}", "1", found.delta_bic, record.tracks
            )
        unexplained = record.verdict == Verdict.UNEXPLAINED.value
        results.add(title, column, "unexplained", "1", float(unexplained), record.tracks)
        results.add(title, column, "time", "s", record.seconds, record.tracks)
    _add_failed(results, of_part(cases, "measured"), records, "measured")


def add_time(results: Results, cases: Sequence[Case], records: Records) -> None:
    """Seconds of one diagnosis that has the machine for itself."""
    seconds = [records[case.name].seconds for case in of_part(cases, "time") if case.name in records]
    if seconds:
        results.add("time", "two processes", "one diagnosis, 50 tracks", "s", median(seconds), len(seconds))
    _add_failed(results, of_part(cases, "time"), records, "time")


def _lines(cases: Sequence[Case]) -> dict[str, list[Case]]:
    """The cases of each subject, then all; empty where there is none."""
    lines = {subject: [c for c in cases if c.subject == subject] for subject in dict.fromkeys(c.subject for c in cases)}
    return lines | {ALL: list(cases)} if cases else {}


def _right(case: Case, records: Records) -> bool:
    return case.name in records and right(records[case.name], case.planted)


def _hides(case: Case) -> bool:
    return PLANTS[case.subject].hidden


def _column(size: float) -> str:
    return f"{size:g} typical"


def _add_failed(results: Results, cases: Sequence[Case], records: Records, title: str) -> None:
    failed = [case for case in cases if case.name not in records]
    if failed:
        results.add(title, FAILED, ALL, "1", float(len(failed)), len(cases))
