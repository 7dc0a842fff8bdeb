"""Prints rows of numbers as tables, with target values and conclusions in sentences."""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Final, TextIO

from ballfg.benchmarks.results import CURVE_MARK, Row
from ballfg.checks import aligned

RIGHT: Final = {"nees": 9.0, "nees_velocity": 3.0, "nis_median": 2.37, "nis_mean": 3.0}
"""Value of a metric where stated covariances are right: degrees of freedom; of `nis_median` chi-square's median."""
GIVEN_SPIN: Final = ("paper",)  # Cases in which every method is given the true spin, which then has no error
GIVEN: Final = "given"  # Replaces the error of given quantities in a table
NEES_PLACE: Final = re.compile(r"nees_\w+")
COVERAGE: Final = re.compile(r"(?:conformal_)?coverage_(\d+)(?:_\w+)?")
NONE_WANTED: Final = ("not_converged", "failed", "places_outside_99")  # Counts whose target is zero
OF_CASE: Final = {
    "naming, spin labels": "1",
    "naming, no spin labels": "1",
    "pairs": "1",
    "silence": "0",
    "unknown physics": "1",
    "repair": "1",
    "planted in measured sets": "1",
}
"""Target values of all shares and ratios of a table of `ballfg-bench loop` or `planted`."""
JUDGED: Final = ("nees", "coverage_90", "nis_median")  # Metrics of the consistency of covariances, the sharpest first
NEAR, NEAR_SHARE = 0.1, 0.03
"""A NEES within 10 % of its target, and a coverage within three points of it, count as right."""
ALIKE: Final = 1.01  # Ratio of errors up to which methods count as equally good
COMPARED: Final = {
    "velocity_rmse": "velocity",
    "position_rmse": "position",
    "spin_rmse": "spin",
    "prediction_rmse_median": "prediction",
    "rest_rmse": "prediction of the unobserved part",
    "track_rmse": "whole track",
    "apex_1_ahead_mean": "apex after the first bounce",
}
"""Errors whose best method is named, and their words."""
WORDS: Final = (
    (re.compile(r"_vs_"), "*_vs_METHOD: ratio of the errors to those of that method, track by track"),
    (re.compile(r"_rmse_all$"), "*_all: with the first samples, where a filter knows little yet"),
    (re.compile(r"_rmse_newest$"), "*_newest: at the newest sample, without any later one"),
    (re.compile(r"^nees"), "nees: squared errors in units of their covariance; more than it should be means too sure"),
    (re.compile(r"^nis"), "nis: the same of new measurements"),
    (re.compile(r"coverage_"), "coverage: share of true values or measurements within their intervals"),
    (re.compile(r"^places_outside"), "places_outside_99: places of the track whose nees is outside its 99 % range"),
)
"""Explanations of metrics for newcomers."""
OF_LOOP: Final = {
    "silence": "of {number} datasets without an effect {% effect named:.1f} % got a wrong name, {% any alarm:.1f} % "
    "any alarm.",
    "repair": "predictions with the corrected model are {after / true:.2f} times as far off as with the true one; with "
    "the declared model they were {before / true:.2f} times as far off.",
    "pairs": "{% both:.0f} % of {number} pairs of effects were named completely; {% first:.0f} % got a right first "
    "name.",
    "planted in measured sets": "of {number} changes {% named:.0f} % were named, {% within 3 sigma:.0f} % also with "
    "their strength.",
    "unknown physics": "physics of no catalogue: {% unexplained:.0f} % called unexplained; errors reduced in "
    "{% reduced:.0f} %.",
}
"""Conclusions from the line over all data of a table of `ballfg-bench loop` or `planted`."""
CASES: Final = {
    "paper": "free flights, true dynamics and spin known to all, noise on states at every step, as in the paper; the "
    "spin is given, not estimated: it adds nothing to nees, and its intervals always hold",
    "fair": "flights with bounces, the same declared noise and the same settings for all",
    "consistency": "more tracks of the fair protocol; brackets of nees_* are the range that chance allows",
}
"""The comparison of each case, by its name."""


def legend(case: str, rows: Sequence[Row]) -> list[str]:
    """Words for a table: its case, the meaning of brackets, and its metrics."""
    metrics = {row.metric for row in rows if CURVE_MARK not in row.metric}
    ranges = any(row.low is not None for row in rows)
    found = [CASES[case]] if case in CASES else []
    found += (
        ["brackets: 95 % range of the number, by resampling tracks"] if ranges and case in ("paper", "fair") else []
    )
    found += [words for pattern, words in WORDS if any(pattern.search(metric) for metric in metrics)]
    return [*found, "unit 1: a pure number"] if any(row.unit == "1" for row in rows) else found


def should_be(case: str, metric: str, unit: str) -> str:
    """The target value of a metric in words; empty if less (or more) is simply better."""
    if case in OF_CASE:
        return OF_CASE[case]
    if metric in NONE_WANTED:
        return "0"
    value = target(metric, unit, case)
    return "" if value is None else f"{value:.3g}"


def is_given(case: str, metric: str) -> bool:
    """True if a metric is the error of a quantity that all methods of the case are given."""
    return case in GIVEN_SPIN and metric.startswith("spin_rmse")


def target(metric: str, unit: str, case: str = "") -> float | None:
    """The value of a metric for consistent covariances; None for other metrics.

    Where the spin is given, three of the nine components of a state have no error: the NEES is that of six, and the
    intervals of three always hold.
    """
    level = COVERAGE.fullmatch(metric)
    value = RIGHT["nees"] if NEES_PLACE.fullmatch(metric) else None
    if level is not None:
        value = float(level[1]) / (1.0 if unit == "%" else 100.0)
    value = RIGHT.get(metric, value)  # where all components of the state are estimated
    if value is None or case not in GIVEN_SPIN:
        return value
    if metric.startswith("nees") and metric != "nees_velocity":
        return value * 6.0 / 9.0
    if level is not None and metric.endswith("_state"):
        return (6.0 * value + 3.0 * (100.0 if unit == "%" else 1.0)) / 9.0
    return value


def conclusions(case: str, rows: Sequence[Row]) -> list[str]:
    """Conclusions from the rows of one case: the best method of each error, and the consistency of covariances."""
    shown = [row for row in rows if CURVE_MARK not in row.metric and row.value is not None]
    by_metric: dict[str, dict[str, Row]] = {}
    for row in shown:
        by_metric.setdefault(row.metric, {})[row.method] = row
    if case in OF_CASE:
        return list(_of_loop(case, by_metric))
    compared = [(words, by_metric.get(metric, {})) for metric, words in COMPARED.items() if not is_given(case, metric)]
    found = [said for words, methods in compared if len(methods) > 1 and (said := _best(words, methods))]
    judged = next((by_metric[metric] for metric in JUDGED if metric in by_metric), None)
    return [*found, *(_covariances(case, judged) if judged else ())]


def _best(words: str, methods: Mapping[str, Row]) -> str:
    """The methods with the smallest error, the next one, and whether chance may have ordered them.

    Returns: a sentence; empty where the best error is zero.
    """
    ordered = sorted(methods.items(), key=lambda item: _value(item[1]))
    least, unit = _value(ordered[0][1]), "" if ordered[0][1].unit == "1" else f" {ordered[0][1].unit}"
    if least <= 0.0:
        return ""
    best = [(name, row) for name, row in ordered if _value(row) <= ALIKE * least]
    names = " and ".join(part for part in (", ".join(n for n, _ in best[:-1]), best[-1][0]) if part)
    said = f"{words}: {names} {'has' if len(best) == 1 else 'have'} the smallest error, {least:.3g}{unit}"
    if len(best) == len(ordered):
        return f"{said}: all methods are equally good."
    following, second = ordered[len(best)]
    more = _value(second)
    overlap = any(row.high is not None and second.low is not None and row.high >= second.low for _, row in best)
    doubt = "; their intervals overlap, so that the order may be chance" if overlap else ""
    return f"{said}; next is {following} with {more:.3g} ({100 * (more / least - 1):.0f} % more){doubt}."


def _covariances(case: str, methods: Mapping[str, Row]) -> Iterator[str]:
    """Methods whose stated uncertainty is right, too small, too large, by one metric."""
    metric, unit = next((row.metric, row.unit) for row in methods.values())
    goal = target(metric, unit, case)
    if goal is None:
        return
    share = metric.startswith("coverage")
    right, small, large = "right", "too small, errors are larger", "too large, errors are smaller"
    sorts: dict[str, list[str]] = {right: [], small: [], large: []}
    for method, row in methods.items():
        value = _value(row)
        inside = row.low is not None and row.high is not None and row.low <= goal <= row.high
        near = abs(value - goal) <= (NEAR_SHARE * (100.0 if unit == "%" else 1.0) if share else NEAR * goal)
        sort = right if inside or near else small if (value < goal) == share else large
        sorts[sort].append(f"{method} ({value:.3g})")
    said = "; ".join(f"{sort}: {', '.join(names)}" for sort, names in sorts.items() if names)
    yield f"stated uncertainty, by {metric} (should be {goal:.3g}) - {said}."


def _of_loop(case: str, by_metric: Mapping[str, Mapping[str, Row]]) -> Iterator[str]:
    """The line over all data of a table of `ballfg-bench loop` or `planted` in words."""
    total = by_metric.get("all", {})
    values = {name: _value(row) for name, row in total.items()}
    number = max((row.n for row in total.values()), default=0)
    if not values:
        return
    if case.startswith("naming"):
        shares = ", ".join(f"{100 * v:.0f} % at {name}" for name, v in values.items() if name.endswith("typical"))
        yield f"planted effects named right: {shares} size."
    elif case in OF_LOOP:
        percent = {f"% {name}": 100 * value for name, value in values.items()}
        with suppress(KeyError):  # a part of the numbers is not there
            yield OF_LOOP[case].format_map({**values, **percent, "number": number})


def _value(row: Row) -> float:
    return float("nan") if row.value is None else row.value


def print_table(rows: Iterable[Row], stream: TextIO | None = None) -> None:
    """One table a case, a line per metric and a column per method; drawn on a terminal, plain text elsewhere.

    Target values stand in a column of their own, conclusions below the table.
    """
    stream = stream or sys.stdout
    shown = [row for row in rows if CURVE_MARK not in row.metric]
    for case in dict.fromkeys(row.case for row in shown):
        of_case = [row for row in shown if row.case == case]
        columns, lines = _pivot(of_case)
        goals = [should_be(case, line[0], line[1]) for line in lines]
        if any(goals):
            columns = [*columns, "should be"]
            lines = [[*line, goal] for line, goal in zip(lines, goals, strict=True)]
        if stream.isatty():
            _print_rich(case, columns, lines, stream)
        else:
            print(f"\n{case}", *aligned([columns, *lines]), sep="\n", file=stream)
        for sentence in conclusions(case, of_case):
            print(f"-> {sentence}", file=stream)
        for words in legend(case, of_case):
            print(f"   {words}", file=stream)


def _pivot(rows: list[Row]) -> tuple[list[str], list[list[str]]]:
    """Column heads, and lines of cells: metric, unit, one cell a method."""
    methods = list(dict.fromkeys(row.method for row in rows))
    keys = list(dict.fromkeys((row.metric, row.unit) for row in rows))
    cells = {(row.metric, row.unit, row.method): _cell(row) for row in rows}
    lines = [[metric, unit, *(cells.get((metric, unit, m), "") for m in methods)] for metric, unit in keys]
    return ["metric", "unit", *methods], lines


def _cell(row: Row) -> str:
    if is_given(row.case, row.metric):
        return GIVEN
    text = _number(row.value)
    return text if row.low is None or row.high is None else f"{text} [{_number(row.low)}, {_number(row.high)}]"


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e6 else f"{value:.3g}"


def _print_rich(case: str, columns: list[str], lines: list[list[str]], stream: TextIO) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=case, title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, overflow="fold", justify="left" if i < 2 else "right")
    for line in lines:
        table.add_row(*line)
    Console(file=stream).print(table)
