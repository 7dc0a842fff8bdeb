"""Reads the tables of `ballfg estimate` and `ballfg predict` back, track by track."""

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.checks import NAME_RULE, is_name, one_line, shown
from ballfg.files.parquet import open_parquet
from ballfg.files.spreadsheet import bare
from ballfg.state import CORRELATIONS, SIGMA_NAMES, STATE_NAMES
from ballfg.tracks import csv_files
from ballfg.tracks.rows import distinct

KEYS = ("trajectory", "t")
LABEL, EVENT = "label", "event"
LARGEST = 1e12  # Largest number in a table, in SI units; sums and squares of larger ones overflow a page's numbers


class Kind(enum.Enum):
    """Kinds of tables; the value names the columns of numbers beside `t`."""

    STATES = (*STATE_NAMES, *SIGMA_NAMES)
    PREDICTIONS = ("x", "y", "z", "sigma_x", "sigma_y", "sigma_z")


@dataclass(frozen=True, eq=False)
class ResultTable:
    """A table of results."""

    path: Path  # of the file
    kind: Kind  # of the table
    rows: Mapping[str, slice]  # of each track, in the order in which the tracks first appear
    values: Array  # (rows, 1 + c) t in s and the columns of the kind, sorted by track and time
    labels: NDArray[np.str_]  # (rows,) what the ball does at each state; empty without the column `label`
    correlations: Array  # (rows, 3) of x and y, x and z, y and z of states; 0 where the table has none
    flights: Index  # (rows,) number of the trajectory in the table that each row is of

    def of(self, name: str) -> Array:
        """(k, 1 + c) rows of a track in the units of the columns; empty for an unknown track."""
        return self.values[self.rows.get(name, slice(0))]

    def joined(self, names: Sequence[str]) -> "ResultTable":
        """The table with the rows of flights, as `TRACK-000`, under the name in `names` of their recording."""
        known, parts = set(names), dict[str, list[NDArray[np.int64]]]()
        for name, rows in self.rows.items():
            track, _, number = name.rpartition("-")
            whole = track if name not in known and track in known and number.isdigit() else name
            parts.setdefault(whole, []).append(np.arange(rows.start, rows.stop))
        order = np.concatenate([np.empty(0, np.int64), *(one for found in parts.values() for one in found)])
        ends = np.cumsum([0, *(sum(map(len, found)) for found in parts.values())]).tolist()
        rows_of = {name: slice(*pair) for name, pair in zip(parts, pairwise(ends), strict=True)}
        labels = self.labels[order] if len(self.labels) else self.labels
        ordered = (self.values[order], labels, self.correlations[order], self.flights[order])
        return ResultTable(self.path, self.kind, rows_of, *ordered)


def kind_of(columns: Sequence[str]) -> Kind | None:
    """The kind of a table with these columns; None for another table, as of events that `ballfg predict` asked for."""
    if EVENT in columns:
        return None
    for kind in Kind:
        if set(KEYS) | set(kind.value) <= set(columns):
            return kind
    return None


def columns_of(path: Path) -> list[str]:
    """The names of a table's columns. Raises: ValueError: the file cannot be read in the format of its ending."""
    if path.suffix.lower() == ".parquet":
        with open_parquet(path) as file:
            return list(file.schema_arrow.names)
    return [name.strip() for name in csv_files.read_header(path)]


def read_table(path: Path, kind: Kind) -> ResultTable:
    """Reads the columns of a kind.

    Raises: ValueError: no rows, text in place of a number, or a stamp that is not finite.
    """
    names, there = [*KEYS, *kind.value], set(columns_of(path)) if kind is Kind.STATES else set[str]()
    labelled, correlated = LABEL in there, there.issuperset(CORRELATIONS)
    names += CORRELATIONS if correlated else ()
    text = pa.dictionary(pa.int32(), pa.string())
    types = {"trajectory": text} | dict.fromkeys(names[1:], pa.float64())
    types |= {LABEL: text} if labelled else {}
    is_csv = path.suffix.lower() != ".parquet"
    try:
        if not is_csv:
            with open_parquet(path) as file:
                found = file.read(columns=[*types]).select([*types])
            found = pa.table({name: _as(found[name], types[name]) for name in types})
        else:
            options = pa_csv.ConvertOptions(
                column_types=types, include_columns=[*types], strings_can_be_null=False, null_values=["", "nan", "NaN"]
            )
            found = pa_csv.read_csv(path, convert_options=options)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} must hold a number in each cell; {one_line(error)[:160]}. Correct it.") from None
    values = np.column_stack([found[name].to_numpy().astype(np.float64) for name in names[1:]])
    end = 1 + len(kind.value)
    correlations = np.nan_to_num(values[:, end:]) if correlated else np.zeros((len(values), len(CORRELATIONS)))
    if not len(values):
        raise ValueError(f"{path} must have rows; it has a header only. Give a table with results.")
    if not np.isfinite(values[:, 0]).all():
        row = int(np.flatnonzero(~np.isfinite(values[:, 0]))[0])
        raise ValueError(
            f"{path}: t must be a finite number of seconds; row {row + 1} has {values[row, 0]}. Correct it."
        )
    far = np.argwhere(np.isfinite(values) & (np.abs(values) > LARGEST))
    if len(far):
        row, column = far[0].tolist()
        raise ValueError(
            f"{path}: {names[1 + column]} must be at most {LARGEST:g} in SI units; row {row + 1} has "
            f"{values[row, column]:g}. Correct it."
        )
    tracks, codes = _tracks(path, found["trajectory"], is_csv)
    order = np.lexsort((values[:, 0], codes))
    ends = np.cumsum(np.bincount(codes, minlength=len(tracks))).tolist()
    rows = map(slice, [0, *ends], ends)
    labels = np.array(found[LABEL].to_pylist() if labelled else [], dtype=np.str_)
    ordered = (values[order, :end], labels[order[: len(labels)]], correlations[order], codes[order])
    return ResultTable(path, kind, dict(zip(tracks, rows, strict=True)), *ordered)


def _as(column: pa.ChunkedArray, kind: pa.DataType) -> pa.ChunkedArray:
    """The column as another type; whole numbers may name tracks."""
    if pa.types.is_dictionary(kind) and not pa.types.is_dictionary(column.type):
        return column.cast(pa.string()).dictionary_encode()
    return column.cast(kind)


def _tracks(path: Path, column: pa.ChunkedArray, is_csv: bool) -> tuple[list[str], NDArray[np.int64]]:
    """The names of the tracks in the order in which they first appear, and the number of each row's track."""
    texts, places = distinct(column.unify_dictionaries().combine_chunks())
    codes_of: dict[str, int] = {}
    codes = []
    for place, text in enumerate(texts):
        if not text or not is_name(text):
            row = int(np.argmax(places == place)) + 1
            got = shown(text or "")
            raise ValueError(f"{path}, row {row}: trajectory must be {NAME_RULE}; got {got}. Rename the track.")
        codes.append(codes_of.setdefault(bare(text) if is_csv else text, len(codes_of)))
    return list(codes_of), np.array(codes, dtype=np.int64)[places]
