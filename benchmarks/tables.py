"""Prints rows of numbers as tables, with target values and conclusions."""

import sys
from collections.abc import Iterable
from typing import TextIO

from ballfg.benchmarks.conclusions import GIVEN, conclusions, is_given, legend, should_be
from ballfg.benchmarks.results import CURVE_MARK, Row


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
            _print_plain(case, columns, lines, stream)
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


def _print_plain(case: str, columns: list[str], lines: list[list[str]], stream: TextIO) -> None:
    widths = [max(len(line[i]) for line in [columns, *lines]) for i in range(len(columns))]
    print(f"\n{case}", file=stream)
    for line in [columns, *lines]:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip(), file=stream)


def _print_rich(case: str, columns: list[str], lines: list[list[str]], stream: TextIO) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=case, title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, overflow="fold", justify="left" if i < 2 else "right")
    for line in lines:
        table.add_row(*line)
    Console(file=stream).print(table)
