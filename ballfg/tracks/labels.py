"""Reads `labels.csv`: the labels of each shot, one row per trajectory."""

from collections.abc import Collection
from pathlib import Path

from ballfg.checks import NAME_RULE, TEXT_RULE, did_you_mean, is_name, is_text, shown
from ballfg.tracks import csv_files
from ballfg.tracks.rows import KEY
from ballfg.tracks.track import FASTEST_SPIN, SPIN_LABELS, Label

LABELS_FILE = "labels.csv"
NUMERIC_LABELS = (*SPIN_LABELS, "topspin", "sidespin", "speed")
TEXT_LABELS = ("group", "split")


class LabelTable:
    """The labels of all trajectories.

    A column is numeric if each of its non-empty cells is a number; `group` and `split` are always text, the spin and
    the launcher settings always numbers. An empty cell means that the trajectory lacks the label.
    """

    def __init__(self, columns: dict[str, list[Label | None]], rows: dict[str, int]) -> None:
        self._columns = columns
        self._rows = rows

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def names(self) -> list[str]:
        """The names of the labels, in the order of the file."""
        return list(self._columns)

    def of(self, trajectory: str) -> dict[str, Label]:
        """The labels of one trajectory; empty if it has no row."""
        row = self._rows.get(trajectory)
        if row is None:
            return {}
        cells = {name: column[row] for name, column in self._columns.items()}
        return {name: value for name, value in cells.items() if value is not None}


def read_labels(path: Path, trajectories: Collection[str]) -> LabelTable:
    """Reads a `labels.csv`.

    Raises: ValueError: a missing or repeated column, a ragged line, a row without a track, a second row for a track, or
        text in place of a number; the message names line and column.
    """
    header = csv_files.read_header(path)
    csv_files.check_header(path, header, (KEY,), (KEY,))
    for name in header:
        if not is_name(name):
            raise ValueError(
                f"{path}, line 1: the name of each column must be {NAME_RULE}; got {shown(name)}. Name it or delete it."
            )
    csv_files.check_header(path, header, (), header)
    rows, lines, cells = _read_rows(path, header, set(trajectories))
    columns = {
        name: _column(path, name, [row[i] for row in cells], lines) for i, name in enumerate(header) if name != KEY
    }
    return LabelTable(columns, rows)


def _read_rows(
    path: Path, header: list[str], trajectories: set[str]
) -> tuple[dict[str, int], list[int], list[list[str]]]:
    """The row number of each trajectory, the line of each row, the cells of each row."""
    key = header.index(KEY)
    rows: dict[str, int] = {}
    lines: list[int] = []
    cells: list[list[str]] = []
    for line, row in csv_files.records(path):
        problem = csv_files.row_problem(header, (), row)
        if problem:
            raise ValueError(f"{path}, line {line}{problem}")
        name = row[key]
        if name in rows:
            raise ValueError(
                f"{path}, line {line}: trajectory {shown(name)} must have one row; line {lines[rows[name]]} is another."
                " Delete one of them."
            )
        if name not in trajectories:
            raise ValueError(
                f"{path}, line {line}: trajectory {shown(name)} must have a track; there is none of that name. "
                f"Names are compared as text, zeros included.{did_you_mean(name, trajectories)}"
            )
        rows[name] = len(cells)
        lines.append(line)
        cells.append(row)
    return rows, lines, cells


def _column(path: Path, name: str, cells: list[str], lines: list[int]) -> list[Label | None]:
    text: list[Label | None] = [cell or None for cell in cells]
    for cell, line in zip(cells, lines, strict=True):
        if not is_text(cell):
            raise ValueError(
                f"{path}, line {line}, column {shown(name)}: must be {TEXT_RULE}; got {shown(cell)}. Correct it."
            )
    if name in TEXT_LABELS:
        return text
    for cell, line in zip(cells, lines, strict=True):
        if cell.strip() and not csv_files.is_number(cell):
            if name not in NUMERIC_LABELS:
                return text
            raise ValueError(
                f"{path}, line {line}, column {shown(name)}: must be a number; got {shown(cell)}. "
                "Correct it, or leave the cell empty if it is unknown."
            )
    values: list[Label | None] = [float(cell) if cell.strip() else None for cell in cells]
    for value, line in zip(values, lines, strict=True):
        if name in SPIN_LABELS and isinstance(value, float) and abs(value) > FASTEST_SPIN:
            raise ValueError(
                f"{path}, line {line}, column {shown(name)}: must be within {FASTEST_SPIN:g} rad/s, as the spin of "
                f"every ball; got {value:g}. Correct it, or leave the cell empty if it is unknown."
            )
    return values
