"""Reads the text exports of motion capture: Qualisys (TSV), Vicon Nexus (CSV), OptiTrack Motive (CSV)."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.importing.formats.raw import MISSING, RawTable, table_of
from ballfg.importing.names import unit_of_text
from ballfg.tracks.csv_files import is_number

AXES: Final = ("X", "Y", "Z")
_HEAD: Final = 40  # number of lines within which a header ends


@dataclass(frozen=True)
class Capture:
    """Markers of a recording: frames per second, unit of length, columns of x, y, z of each, and rows of cells."""

    rate: float | None
    unit: str
    places: dict[str, tuple[int, int, int]]
    time: int | None
    rows: Sequence[Sequence[str]]
    empty: str = ""  # what a missing position looks like, besides an empty cell


def capture_table(text: str, name: str, source: str) -> RawTable | None:
    """The long table of a motion capture export, with the columns marker, t, x, y, z; None for any other text."""
    lines = text.splitlines()
    first = lines[0] if lines else ""
    if first.startswith("NO_OF_FRAMES"):
        found = _qualisys(lines)
    elif first.startswith("Format Version"):
        found = _motive(lines)
    elif first.strip().strip(",") == "Trajectories":
        found = _vicon(lines)
    else:
        return None
    if found is None or not found.places or not found.rows:
        return None
    markers, stamps, positions = list[str](), list[Array](), list[Array]()
    times = _times(found)
    for marker, places in found.places.items():
        here = np.stack([_numbers(found.rows, place, found.empty) for place in places], axis=1)
        seen = np.isfinite(here).all(axis=1) & ((here != 0.0).any(axis=1) | (found.empty == ""))
        markers += [marker] * int(seen.sum())
        stamps.append(times[seen])
        positions.append(here[seen])
    joined = np.concatenate(positions)
    axes = {f"{axis.lower()} [{found.unit}]": joined[:, k] for k, axis in enumerate(AXES)}
    return table_of(name, {"marker": markers, "t [s]": np.concatenate(stamps), **axes}, source)


def _times(found: Capture) -> Array:
    """(n,) s, of the rows; without a rate and a column of times, their numbers."""
    if found.time is not None:
        return _numbers(found.rows, found.time, "")
    return np.arange(len(found.rows)) / (found.rate or 1.0)


def _numbers(rows: Sequence[Sequence[str]], place: int, empty: str) -> Array:
    cells = (row[place] if place < len(row) else "" for row in rows)
    return np.array([np.nan if cell == empty or cell.lower() in MISSING else float(cell) for cell in cells])


def _rows(lines: Sequence[str], separator: str) -> list[list[str]]:
    return [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator)]


def _qualisys(lines: Sequence[str]) -> Capture | None:
    """A header of keys, one a line, then rows of x, y, z for each marker, in mm, with zeros where one is hidden."""
    rows = _rows(lines, "\t")
    keys = {row[0]: row[1:] for row in rows[:_HEAD] if row and row[0].isupper() and row[0].replace("_", "").isalpha()}
    names = [name for name in keys.get("MARKER_NAMES", []) if name]
    start = next((i for i, row in enumerate(rows) if row and is_number(row[0])), None)
    if not names or start is None:
        return None
    data = [row for row in rows[start:] if any(row)]
    before = max(len([cell for cell in data[0] if cell]) - 3 * len(names), 0)  # frame and time, where exported
    header = rows[start - 1]
    time = header.index("Time") if "Time" in header else 1 if before == 2 else None
    rate = float(keys["FREQUENCY"][0]) if keys.get("FREQUENCY") else None
    places = {name: (before + 3 * k, before + 3 * k + 1, before + 3 * k + 2) for k, name in enumerate(names)}
    return Capture(rate, "mm", places, time, data, "0.000")


def _motive(lines: Sequence[str]) -> Capture | None:
    """Rows of names, of what is measured and of axes above the columns."""
    rows = _rows(lines, ",")
    keys = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    end = next((i for i, row in enumerate(rows[:_HEAD]) if row and row[0] == "Frame"), None)
    named = next((row for row in rows[:_HEAD] if len(row) > 1 and row[1] == "Name"), None)
    if end is None or named is None:
        return None
    kinds, axes = rows[end - 1], rows[end]
    places: dict[str, list[int]] = {}
    for k in range(2, len(axes)):
        if k < len(kinds) and kinds[k] == "Position" and axes[k] in AXES:
            places.setdefault(named[k], []).append(k)
    unit = unit_of_text(keys.get("Length Units", "")) or "m"
    whole = {name: (found[0], found[1], found[2]) for name, found in places.items() if len(found) == 3}
    data = [row for row in rows[end + 1 :] if row and is_number(row[0])]
    return Capture(None, unit, whole, 1, data)


def _vicon(lines: Sequence[str]) -> Capture | None:
    """Rate, names above every third column, axes, units, then rows with frame and subframe; other sections follow."""
    rows = _rows(lines, ",")
    if len(rows) < 6 or not is_number(rows[1][0] if rows[1] else ""):
        return None
    names, axes, units = rows[2], rows[3], rows[4]
    marked = [(name.rpartition(":")[2], k) for k, name in enumerate(names) if name]
    places = {name: (k, k + 1, k + 2) for name, k in marked if list(axes[k : k + 3]) == list(AXES)}
    unit = next((cell for cell in units if unit_of_text(cell)), "mm")
    section = takewhile(lambda row: bool(row) and is_number(row[0]), rows[5:])
    return Capture(float(rows[1][0]), unit, places, None, list(section))
