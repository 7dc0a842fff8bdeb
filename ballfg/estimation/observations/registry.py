"""Registers the kinds of observation by name, and reads and writes their tables: `trajectory,t,<values>,sigma`."""

from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.estimation.observations.observation import Observation
from ballfg.estimation.observations.positions import Positions
from ballfg.estimation.observations.reading import RadarSpeed, SpinReading
from ballfg.estimation.observations.sightings import CameraSightings
from ballfg.files.python_file import load_classes
from ballfg.registry import Registry
from ballfg.tracks import Track, csv_files
from ballfg.tracks.rows import KEY

LONGEST_HEADER: Final = 4096  # Largest number of bytes read from a table's first line

OBSERVATIONS: Final[Registry[Observation]] = Registry(
    "observation", group="ballfg.observations", base=Observation, remedy="docs/custom_factors.md has an example."
)
register_observation = OBSERVATIONS.register
"""Registers an observation, so that it is read from the folder of a dataset; may decorate the class."""
for _own in (Positions, CameraSightings, RadarSpeed, SpinReading):
    register_observation(_own)


def load_observations(path: str | Path) -> tuple[type[Observation], ...]:
    """Runs a Python file and registers its observations, except for classes whose name begins with `_`.

    Args: path: of a file that you trust: all of its code runs.
    Returns: the classes, in the order in which they stand there.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no Python, does not run, defines no observation, or one that cannot be registered.
    """
    return load_classes(OBSERVATIONS, path)


@dataclass
class ReadingTables:
    """The readings of a folder: rows (m, 2 + dim) t (s), values, sigma by sort and trajectory; notes on ignored."""

    rows: dict[type[Observation], dict[str, Array]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def attached(self, track: Track) -> Track:
        """The track with its readings; readings before its first and after its last sample are left out."""
        own = {sort: tables[track.name] for sort, tables in self.rows.items() if track.name in tables}
        inside = {s: t[(t[:, 0] >= track.times[0]) & (t[:, 0] <= track.times[-1])] for s, t in own.items()}
        return track.observed(*(sort.from_table(track, table) for sort, table in inside.items() if len(table)))


def read_readings(folder: str | PathLike[str], trajectories: Collection[str]) -> ReadingTables:
    """All tables of readings in a folder, of every registered kind.

    Args: folder: of a dataset.  trajectories: names of its tracks.
    Raises: ValueError: a missing column, a row of an unknown trajectory, or a cell that is no number; the message names
        file, line and column. A table of readings of no registered kind.
    """
    tables, known = ReadingTables(), set(trajectories)
    for name, sort in tables_of_readings(folder).items():
        tables.rows[sort] = _read(Path(folder) / name, sort, known, tables.notes)
    return tables


def tables_of_readings(folder: str | PathLike[str]) -> dict[str, type[Observation]]:
    """The tables of readings in a dataset's folder, by name, with the kind of each.

    Results and other tables may lie there too: tables of readings have the columns `trajectory`, `t` and `sigma`.

    Raises: ValueError: if a table of readings is of no registered kind.
    """
    sorts = {sort.file: sort for sort in OBSERVATIONS.values() if sort.file is not None}
    found = {name: sort for name, sort in sorts.items() if (Path(folder) / name).is_file()}
    for path in sorted(Path(folder).glob("*.csv")):
        if path.name in found or not path.is_file():
            continue
        with path.open("rb") as file:
            header = file.readline(LONGEST_HEADER).removeprefix(b"\xef\xbb\xbf")
        if {KEY.encode(), b"t", b"sigma"} <= {cell.strip().strip(b'"') for cell in header.split(b",")}:
            raise ValueError(
                f"{path} must belong to an observation; none that is known reads it: "
                f"{', '.join(f'{file} ({sort.name})' for file, sort in sorts.items())}. "
                "Name the file of its class with --observations-file, register the class, or move the table away."
            )
    return found


def _read(path: Path, sort: type[Observation], known: set[str], notes: list[str]) -> dict[str, Array]:
    """Rows of each trajectory of one table."""
    header = csv_files.read_header(path)
    wanted = ("t", *sort.columns, "sigma")
    given = shown(",".join(header))
    for name in (KEY, *wanted):
        if header.count(name) != 1:
            raise ValueError(
                f"{path}: must have the columns {', '.join((KEY, *wanted))}, each once; got {given}. "
                f"Add or rename {shown(name)}."
            )
    notes += [f"{path.name}: column {shown(name)} ignored" for name in header if name not in (KEY, *wanted)]
    places, key = [header.index(name) for name in wanted], header.index(KEY)
    rows: defaultdict[str, list[list[float]]] = defaultdict(list)
    for line, cells in csv_files.records(path):
        if len(cells) != len(header):
            raise ValueError(
                f"{path}, line {line}: must have {len(header)} cells; got {len(cells)}. Complete the line."
            )
        if cells[key] not in known:
            raise ValueError(
                f"{path}, line {line}: trajectory {shown(cells[key])} must have a track; there is none of that name. "
                "Names are compared as text, zeros included."
            )
        for place in places:
            name, cell, rule = header[place], cells[place], ""
            if not csv_files.is_number(cell) or (name == "sigma" and not float(cell) > 0.0):
                rule = "a positive number" if name == "sigma" else "a number"
            elif name in sort.columns and abs(float(cell)) > sort.largest:
                rule = f"within {sort.largest:g}, as of every ball"
            if rule:
                raise ValueError(
                    f"{path}, line {line}, column {shown(name)}: must be {rule}; got {shown(cell)}. "
                    "Correct it, or delete the line."
                )
        rows[cells[key]].append([float(cells[place]) for place in places])
    return {name: np.array(numbers) for name, numbers in rows.items()}
