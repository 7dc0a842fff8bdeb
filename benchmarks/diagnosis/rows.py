"""Makes rows of results from the records of the loop's cases; docs/benchmarks.md explains the metrics."""

from collections.abc import Mapping, Sequence
from functools import partial

from ballfg.benchmarks.diagnosis.cases import BARE, PLANTS, STATED_NOISE, Case
from ballfg.benchmarks.diagnosis.record import Record, alarmed, complete, false_names, right
from ballfg.benchmarks.metrics import median_and_range, share
from ballfg.benchmarks.results import Results
from ballfg.diagnosis.result import Verdict

ALL = "all"
HIDDEN = "all that hide"  # Rows over the effects that have equals; `ALL` is over the others
FAILED = "failed"  # Metric of the number of cases of a part that ended in an error; they count as wrong
TITLES = {
    "naming": "naming, spin labels",
    "no_labels": "naming, no spin labels",
    "pairs": "pairs",
    "silence": "silence",
    "unknown": "unknown physics",
    "measured": "measured",
    "time": "time",
}
"""The name in `results.json` of each part's rows."""
FEW_TRACKS = 25  # Null datasets of so many tracks are also counted apart

Records = Mapping[str, Record]


def of_part(cases: Sequence[Case], part: str) -> list[Case]:
    """The cases of a part."""
    return [case for case in cases if case.part == part]


def add_all(results: Results, cases: Sequence[Case], records: Records) -> None:
    """The rows of every part; of each the number of failed cases, where there are some."""
    for part in ("naming", "no_labels"):
        _add_naming(results, of_part(cases, part), records, TITLES[part])
    _add_pairs(results, of_part(cases, "pairs"), records)
    _add_silence(results, of_part(cases, "silence"), records)
    _add_repair(results, [case for case in cases if case.repair and case.name in records], records)
    _add_unknown(results, of_part(cases, "unknown"), records)
    for case in of_part(cases, "measured"):
        if case.name in records:
            _add_measured(results, case, records[case.name])
    seconds = [records[case.name].seconds for case in of_part(cases, "time") if case.name in records]
    if seconds:
        row = ("time", "two processes", "one diagnosis, 50 tracks")
        results.add(*row, "s", median_and_range(seconds), len(seconds))
    for part, title in TITLES.items():
        failed = [case for case in of_part(cases, part) if case.name not in records]
        if failed:
            results.add(title, FAILED, ALL, "1", float(len(failed)), len(of_part(cases, part)))


def _add_share(results: Results, title: str, column: str, line: str, outcomes: Sequence[bool]) -> None:
    if outcomes:
        results.add(title, column, line, "1", share(outcomes), len(outcomes))


def _lines(cases: Sequence[Case]) -> dict[str, list[Case]]:
    """The cases of each subject, then all; empty where there is none."""
    lines = {subject: [c for c in cases if c.subject == subject] for subject in dict.fromkeys(c.subject for c in cases)}
    return lines | {ALL: list(cases)} if cases else {}


def _right(case: Case, records: Records) -> bool:
    return case.name in records and right(records[case.name], case.planted)


def _add_naming(results: Results, cases: Sequence[Case], records: Records, title: str) -> None:
    """Share named right, a line an effect and a column a size; then over all effects, those that hide apart."""
    lines = _lines(cases)
    every = lines.pop(ALL, [])
    lines |= {
        ALL: [case for case in every if not PLANTS[case.subject].hidden],
        HIDDEN: [case for case in every if PLANTS[case.subject].hidden],
    }
    for line, chosen in lines.items():
        for size in dict.fromkeys(case.size for case in chosen):
            outcomes = [_right(case, records) for case in chosen if case.size == size]
            _add_share(results, title, f"{size:g} typical", line, outcomes)


def _add_pairs(results: Results, cases: Sequence[Case], records: Records) -> None:
    """For two effects at once: is the first finding one of them, are both found and nothing else?"""
    for line, chosen in _lines(cases).items():
        both = [case.name in records and complete(records[case.name], case.planted) for case in chosen]
        _add_share(results, "pairs", "first", line, [_right(case, records) for case in chosen])
        _add_share(results, "pairs", "both", line, both)


def _add_silence(results: Results, cases: Sequence[Case], records: Records) -> None:
    """False alarms: an effect named, and any verdict but that nothing is lacking; over all, and by kind of data."""
    kinds = {
        ALL: list(cases),
        "noise larger than stated": [c for c in cases if c.recording.position > STATED_NOISE],
        "noise smaller than stated": [c for c in cases if c.recording.position <= STATED_NOISE],
        "spin labels": [c for c in cases if c.recording.labels],
        "no spin labels": [c for c in cases if not c.recording.labels],
        "few launcher settings": [c for c in cases if c.recording.levels],
        f"at most {FEW_TRACKS} tracks": [c for c in cases if c.recording.tracks <= FEW_TRACKS],
    }
    for line, chosen in kinds.items():
        done = [(records.get(case.name), case.recording) for case in chosen]
        by_name = [record is None or bool(false_names(record, recording)) for record, recording in done]
        any_alarm = [record is None or alarmed(record, recording) for record, recording in done]
        _add_share(results, "silence", "effect named", line, by_name)
        _add_share(results, "silence", "any alarm", line, any_alarm)


def _add_repair(results: Results, cases: Sequence[Case], records: Records) -> None:
    """Prediction error with the corrected and with the declared model, over that of the true one; seeds' median."""
    for line, chosen in _lines(cases).items():
        errors = [records[case.name].errors for case in chosen]
        for column, which in (("after / true", "after"), ("before / true", "before")):
            ratios = [one[which] / one["true"] for one in errors]
            results.add("repair", column, line, "1", median_and_range(ratios), len(ratios))


def _add_unknown(results: Results, cases: Sequence[Case], records: Records) -> None:
    """Physics of no catalogue: called unexplained, error reduced by the fallback, both, and by how much."""
    title = TITLES["unknown"]
    for line, own in _lines(cases).items():
        done = [records.get(case.name) for case in own]
        called = [record is not None and record.verdict == Verdict.UNEXPLAINED.value for record in done]
        errors = [{} if record is None else record.errors for record in done]
        ratios = [one["fallback"] / one["named"] if "fallback" in one else None for one in errors]
        reduced = [ratio is not None and ratio < 1.0 for ratio in ratios]
        _add_share(results, title, "unexplained", line, called)
        _add_share(results, title, "reduced", line, reduced)
        _add_share(results, title, "both", line, [c and r for c, r in zip(called, reduced, strict=True)])
        known = [ratio for ratio in ratios if ratio is not None]
        if known:
            results.add(title, "error with / without fallback", line, "1", median_and_range(known), len(known))


def _add_measured(results: Results, case: Case, record: Record) -> None:
    """A measured dataset: errors before and after, and each finding with its BIC difference."""
    column = "bare model" if case.planted == BARE else "nominal model"
    add = partial(results.add, case.subject.removesuffix("-bare"), column)
    for which in ("before", "after", "fallback"):
        if which in record.errors:
            add(f"prediction_rmse_{which}", "mm", record.errors[which], record.judged)
    add("after / before", "1", record.errors["after"] / record.errors["before"], record.judged)
    for place, found in enumerate(record.found, start=1):
        add(f"delta_bic of finding {place}, {found.name}", "1", found.delta_bic, record.tracks)
    add("unexplained", "1", float(record.verdict == Verdict.UNEXPLAINED.value), record.tracks)
    add("time", "s", record.seconds, record.tracks)
