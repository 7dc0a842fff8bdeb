"""Reads `labels.csv`: the labels of each shot, one row per trajectory."""

from collections.abc import Collection, Sequence
from pathlib import Path

from ballfg.checks import NAME_RULE, TEXT_RULE, did_you_mean, is_name, is_text, shown
from ballfg.tracks import csv_files
from ballfg.tracks.rows import KEY
from ballfg.tracks.track import FASTEST_SPIN, SPIN_LABELS, Label

LABELS_FILE = "labels.csv"
NUMERIC_LABELS = (*SPIN_LABELS, "topspin", "sidespin", "speed")
TEXT_LABELS = ("group", "split")
MOST_ABSURD = 0.1
"""Share of the spin labels that may be beyond the spin of every ball: they are set aside; more are no slips."""


class LabelTable:
    """The labels of all trajectories.

    A column is numeric if each of its non-empty cells is a number; `group` and `split` are always text, the spin and
    the launcher settings always numbers. An empty cell means that the trajectory lacks the label.
    """

    def __init__(self, columns: dict[str, list[Label | None]], rows: dict[str, int], notes: Sequence[str] = ()) -> None:
        self._columns = columns
        self._rows = rows
        self.notes = tuple(notes)
        """On spin labels that were set aside, one sentence each."""

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
    """Reads a `labels.csv`. Raises: ValueError: a bad column or row; the message names line and column."""
    header = csv_files.read_header(path)
    csv_files.check_header(path, header, (KEY,), (KEY,))
    for name in header:
        if not is_name(name):
            raise ValueError(
                f"{path}, line 1: the name of each column must be {NAME_RULE}; got {shown(name)}. Name it or delete it."
            )
    csv_files.check_header(path, header, (), header)
    known, key = set(trajectories), header.index(KEY)
    found: dict[str, tuple[int, list[str]]] = {}  # line and cells of each trajectory
    for line, row in csv_files.records(path):
        if problem := csv_files.row_problem(header, (), row):
            raise ValueError(f"{path}, line {line}{problem}")
        name, where = row[key], f"{path}, line {line}: trajectory {shown(row[key])}"
        if name in found:
            raise ValueError(f"{where} must have one row; line {found[name][0]} is another. Delete one of them.")
        if name not in known:
            raise ValueError(
                f"{where} must have a track; there is none of that name. Names are compared as text, zeros "
                f"included.{did_you_mean(name, known)}"
            )
        found[name] = line, row
    lines = [line for line, _ in found.values()]
    texts = {name: [row[i] for _, row in found.values()] for i, name in enumerate(header) if name != KEY}
    columns = {name: _column(path, name, cells, lines) for name, cells in texts.items()}
    notes = _set_aside(path, columns, lines) + _partial(path, columns)
    return LabelTable(columns, {name: number for number, name in enumerate(found)}, notes)


def _set_aside(path: Path, columns: dict[str, list[Label | None]], lines: list[int]) -> list[str]:
    """Removes spin labels that no ball has from the columns, with a note on each.

    Raises: ValueError: if they are more than `MOST_ABSURD` of all spin labels.
    """
    spins = [column for name, column in columns.items() if name in SPIN_LABELS]
    labelled = sum(any(cell is not None for cell in row) for row in zip(*spins, strict=True))
    notes: list[str] = []
    for name, column in columns.items():
        for number, value in enumerate(column if name in SPIN_LABELS else ()):
            if not isinstance(value, float) or abs(value) <= FASTEST_SPIN:
                continue
            rule = f"within {FASTEST_SPIN:g} rad/s, as the spin of every ball"
            if len(notes) + 1 > MOST_ABSURD * labelled:
                raise ValueError(
                    f"{path}, line {lines[number]}, column {shown(name)}: must be {rule}; got {value:g}. Correct it, "
                    "or leave the cell empty if it is unknown."
                )
            notes.append(f"{path.name}, line {lines[number]}: {name} {value:g} is not {rule}: the label is set aside")
            for spin in spins:
                spin[number] = None
    return notes


def _partial(path: Path, columns: dict[str, list[Label | None]]) -> list[str]:
    """A note on trajectories with some components of the spin: estimators need all three."""
    spins = [columns[name] for name in SPIN_LABELS if name in columns]
    rows = list(zip(*spins, strict=True))
    count = sum(0 < sum(cell is not None for cell in row) < len(SPIN_LABELS) for row in rows)
    what = f"trajectories with only a part of {','.join(SPIN_LABELS)}: their spin is not used"
    return [f"{path.name}: {count} of {len(rows)} {what}"] if count else []


def _column(path: Path, name: str, cells: list[str], lines: list[int]) -> list[Label | None]:
    def refuse(
        number: int, problem: str, remedy: str = "Correct it, or leave the cell empty if it is unknown."
    ) -> None:
        raise ValueError(f"{path}, line {lines[number]}, column {shown(name)}: must be {problem}. {remedy}")

    text: list[Label | None] = [cell or None for cell in cells]
    for number, cell in enumerate(cells):
        if not is_text(cell):
            refuse(number, f"{TEXT_RULE}; got {shown(cell)}", "Correct it.")
    others = [number for number, cell in enumerate(cells) if cell.strip() and not csv_files.is_number(cell)]
    if name in TEXT_LABELS or (others and name not in NUMERIC_LABELS):
        return text
    if others:
        refuse(others[0], f"a number; got {shown(cells[others[0]])}")
    values: list[Label | None] = [float(cell) if cell.strip() else None for cell in cells]
    return values
