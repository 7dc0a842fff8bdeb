"""Cuts rows into shots: by a column, by file, where time restarts, and at gaps."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.checks import MAX_TEXT, NAME_RULE, is_name, listed, short_text, shown
from ballfg.importing.choices import Choices, UndecidedError
from ballfg.importing.columns import UNMEASURED, Roles
from ballfg.importing.formats.raw import Column, RawTable, is_number, numbers
from ballfg.importing.names import meanings, says_seen
from ballfg.importing.stamps import Stamps, as_stamps, joined, missing
from ballfg.progress import counted
from ballfg.tracks.track import Label

_DISORDER: Final = 3.0  # median steps: an earlier stamp within this came late; beyond it a new shot begins
_LARGEST: Final = 1e15  # in the source's units; a larger number is not a position in any unit, and counts as missing
_ALONE: Final = 5.0  # median steps from a neighbour at which a row with x = y = z is a mark of a missing sample
_YES: Final = ("1", "1.0", "true", "yes")
_NO: Final = ("0", "0.0", "false", "no")
GAP: Final = 0.5  # s without samples after which a new shot begins
GAP_STEPS: Final = 20.0  # least number of median steps in such a gap


@dataclass(frozen=True)
class SourceShot:
    """The samples of one shot in the units of their source."""

    name: str
    stamps: Stamps  # (n,) non-decreasing
    positions: Array  # (n, 3)
    sigmas: Array | None  # (n, 3)
    labels: Mapping[str, Label]
    rows: NDArray[np.intp]  # (n,) index into the source's table
    table: RawTable


@dataclass
class Counts:
    """Counts of omitted or reordered rows."""

    missing: int = 0
    unseen: int = 0
    marks: int = 0
    late: int = 0
    short: int = 0
    ignored: set[str] = field(default_factory=set)
    dates: bool = False

    def notes(self) -> list[str]:
        """One sentence for each kind."""
        said = {
            f"{counted(self.missing, 'row')} without a time or a position left out": self.missing,
            f"{counted(self.unseen, 'row')} whose own column says that the ball was not seen left out": self.unseen,
            counted(self.marks, "row")
            + " with x = y = z far from their neighbours left out as missing samples": self.marks,
            f"{counted(self.late, 'row')} put in the order of their times": self.late,
            f"{counted(self.short, 'shot')} of fewer than two samples left out": self.short,
            f"columns left out: {', '.join(sorted(self.ignored))}": self.ignored,
        }
        return [sentence for sentence, count in said.items() if count]


def cut(table: RawTable, roles: Roles, choices: Choices, counts: Counts) -> list[SourceShot]:
    """A table's shots, by the trajectory column or where time restarts. Raises: UndecidedError, ValueError."""
    alone = (name for name in (roles.frame, roles.trajectory) if name is not None)
    places = [name for name in roles.places if name != UNMEASURED]
    needed = (*roles.time, *places, *alone, *(roles.sigmas or ()), *roles.identities)
    lacking = [name for name in needed if name not in table.columns]
    if lacking:
        raise ValueError(f"{table.where} must have the columns of the other tables; {listed(lacking)} missing. Add it.")
    stamps = _stamps(table, roles, choices, counts)
    columns = [numbers(table.columns[one]) if one != UNMEASURED else np.zeros(len(table)) for one in roles.places]
    positions, sigmas = np.stack(columns, axis=1), None
    held = ~missing(stamps) & (np.abs(positions) <= _LARGEST).all(axis=1)
    if roles.sigmas is not None:
        sigmas = np.stack([numbers(table.columns[name]) for name in roles.sigmas], axis=1)
        held &= ((sigmas > 0) & (sigmas <= _LARGEST)).all(axis=1)
    counts.missing += int((~held).sum())
    rows = np.flatnonzero(held & _seen(table, roles.others, held, counts))
    if not len(rows):
        what = f"{table.where}: no row has a time and a position in {', '.join((*roles.time, *roles.places))}"
        raise UndecidedError(what, "columns", (), "t=NAME,x=NAME,y=NAME,z=NAME")
    if roles.trajectory is None:
        parts = _at_restarts(stamps, rows, counts)
        names = [f"{i:03d}" for i in range(len(parts))]
    else:
        column = _identity(table, roles)
        parts, names = _by_name(column, stamps, rows, counts)
        for name, part in zip(names, parts, strict=True):
            if not is_name(name):
                rule = f"{table.where}, row {part[0] + 1}, column {shown(roles.trajectory)}: must be {NAME_RULE}"
                raise ValueError(f"{rule}; got {shown(name)}. Rename the shot.")
    found = []
    labels = _labels(table, roles.others, parts, counts)
    for i, (name, part) in enumerate(zip(names, parts, strict=True)):
        part = part[~_marks(positions[part], counts)]
        if len(part) < 2:
            counts.short += 1
            continue
        own = None if sigmas is None else sigmas[part]
        known = {key: value for key, values in labels.items() if (value := values[i]) is not None}
        found.append(SourceShot(name, stamps[part], positions[part], own, known, part, table))
    return found


def _identity(table: RawTable, roles: Roles) -> Column:
    """(n,) what tells the shots apart: the trajectory, with the ball where several share one."""
    assert roles.trajectory is not None
    columns = [table.texts.get(name, table.columns[name]) for name in (roles.trajectory, *roles.identities)]
    if len(columns) == 1:
        return columns[0]
    joined = np.empty(len(table), dtype=object)
    joined[:] = ["-".join(map(str, row)) for row in zip(*(column.tolist() for column in columns), strict=True)]
    return joined


def split_at_gaps(shots: Iterable[SourceShot], unit: float, gap: float) -> list[SourceShot]:
    """The shots, cut at gaps of `gap` s. Args: unit: s in the unit of the stamps.  gap: s."""
    found: list[SourceShot] = []
    for shot in shots:
        steps = np.diff(shot.stamps).astype(np.float64) * unit
        places = np.flatnonzero(steps > gap) + 1
        if not len(places):
            found.append(shot)
            continue
        cuts = [0, *places.tolist(), len(shot.stamps)]
        pieces = [slice(a, b) for a, b in pairwise(cuts) if b - a >= 2]
        for i, part in enumerate(pieces):
            sigmas = None if shot.sigmas is None else shot.sigmas[part]
            name, stamps, positions = f"{shot.name}-{i:03d}", shot.stamps[part], shot.positions[part]
            found.append(SourceShot(name, stamps, positions, sigmas, shot.labels, shot.rows[part], shot.table))
    return found


def _stamps(table: RawTable, roles: Roles, choices: Choices, counts: Counts) -> Stamps:
    if roles.time and choices.rate is not None:
        what = f"--rate is for sources without times; {table.where} has them in {listed(roles.time)}"
        remedy = "Leave --rate out, or name the column of frames: --columns frame=NAME"
        raise ValueError(f"{what}, and got {choices.rate:g}. {remedy}.")
    if len(roles.time) == 2:
        return joined(*(table.columns[name] for name in roles.time))
    rate = choices.rate or roles.rate
    if not roles.time:
        frames = None if roles.frame is None else numbers(table.columns[roles.frame])
        if rate is None:
            for name, cells in table.columns.items():
                if not is_number(cells) and any(one.role == "t" for one in meanings(name)):
                    raise _no_stamps(table, name)
            seen = (
                f"has no column of times, but {listed(table.columns)}" if frames is None else "has frames but no time"
            )
            raise UndecidedError(f"{table.where} {seen}: the number of frames per second is needed", "rate", (), "120")
        return (np.arange(len(table), dtype=np.float64) if frames is None else frames) / rate
    column = table.columns[roles.time[0]]
    stamps = as_stamps(column)
    if stamps is None:
        raise _no_stamps(table, roles.time[0])
    counts.dates |= column.dtype.kind == "O"
    return stamps


def _no_stamps(table: RawTable, name: str) -> UndecidedError:
    rule = f"{table.where}: the column of times, {shown(name)}, must hold numbers or dates, as 2026-03-31 17:05:09.25"
    return UndecidedError(f"{rule}; it holds {shown(str(table.columns[name][0])[:30])}", "columns", (), "t=NAME")


def _at_restarts(stamps: Stamps, rows: NDArray[np.intp], counts: Counts) -> list[NDArray[np.intp]]:
    """Cuts where the time jumps back; a few late stamps are sorted, and a table from last to first is reversed."""
    steps = np.diff(stamps[rows]).astype(np.float64)
    if len(steps) and (steps < 0).mean() > 0.5:
        counts.late += len(rows)
        rows = rows[::-1]
        steps = -steps[::-1]
    typical = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    parts = np.split(rows, np.flatnonzero(steps < -_DISORDER * typical) + 1)
    return [_ordered(part, stamps, counts) for part in parts]


def _ordered(part: NDArray[np.intp], stamps: Stamps, counts: Counts) -> NDArray[np.intp]:
    late = int((np.diff(stamps[part]) < 0).sum())
    counts.late += late
    return part[np.argsort(stamps[part], kind="stable")] if late else part


def _by_name(
    column: Column, stamps: Stamps, rows: NDArray[np.intp], counts: Counts
) -> tuple[list[NDArray[np.intp]], list[str]]:
    codes_of: dict[str, int] = {}  # an array of texts would give each row the room of the longest
    codes = np.array([codes_of.setdefault(str(value), len(codes_of)) for value in column[rows].tolist()])
    order = np.argsort(codes, kind="stable")
    parts = np.split(rows[order], np.flatnonzero(np.diff(codes[order])) + 1)
    values = [column[part[0]] for part in parts]
    whole = [isinstance(value, float | np.floating) and float(value).is_integer() for value in values]
    names = [
        f"{value:.0f}" if is_whole else str(value) or "unnamed" for value, is_whole in zip(values, whole, strict=True)
    ]
    return [_ordered(part, stamps, counts) for part in parts], names


def _seen(table: RawTable, names: Iterable[str], held: NDArray[np.bool_], counts: Counts) -> NDArray[np.bool_]:
    """Rows at which no column such as `valid` is 0 or false; a column without any 1 tells nothing."""
    seen = np.ones(len(table), dtype=bool)
    for name in names:
        column = table.columns.get(name)
        if column is None or not says_seen(name):
            continue
        cells = np.array([str(cell).lower() for cell in column.tolist()])
        yes, no = np.isin(cells, _YES), np.isin(cells, _NO)
        if (yes | no).all() and yes.any():
            seen &= yes
    counts.unseen += int((held & ~seen).sum())
    return seen


def _marks(positions: Array, counts: Counts) -> NDArray[np.bool_]:
    """Rows of one number, such as 0 or -9999, that trackers write where they did not see the ball."""
    alike = np.ptp(positions, axis=1) == 0.0
    seen = np.flatnonzero(~alike)
    if not alike.any() or not len(seen):
        return np.zeros(len(alike), dtype=bool)
    typical = float(np.median(np.linalg.norm(np.diff(positions[seen], axis=0), axis=1))) if len(seen) > 2 else 0.0
    after = np.searchsorted(seen, np.arange(len(alike)))  # index into the seen rows
    neighbours = (seen[np.maximum(after - 1, 0)], seen[np.minimum(after, len(seen) - 1)])
    off = np.max([np.linalg.norm(positions - positions[rows], axis=1) for rows in neighbours], axis=0)
    marks = alike & (off > _ALONE * typical)
    counts.marks += int(marks.sum())
    return np.asarray(marks)


def _labels(
    table: RawTable, names: Iterable[str], parts: list[NDArray[np.intp]], counts: Counts
) -> dict[str, list[Label | None]]:
    found: dict[str, list[Label | None]] = {}
    for name in names:
        column = table.columns.get(name)
        if column is None:  # in the first table, but not in this one
            counts.ignored.add(name)
        elif all((column[part] == column[part[0]]).all() for part in parts) and is_name(name) and name != "trajectory":
            cells = [column[part[0]] for part in parts]
            if is_number(column):
                found[name] = [float(cell) if np.isfinite(cell) else None for cell in cells]
            else:
                found[name] = [short_text(" ".join(str(cell).split()), MAX_TEXT) or None for cell in cells]
        elif not is_number(column) or np.isfinite(numbers(column)).any():
            counts.ignored.add(name)
    return found
