"""The tables that `ballfg estimate` and `ballfg predict` write, read back track by track."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from ballfg.arrays import Array
from ballfg.checks import one_line
from ballfg.files.damaged import check_unpacked, library_reads
from ballfg.state import SIGMA_NAMES, STATE_NAMES

KEYS = ("trajectory", "t")
LARGEST = 1e12
"""Of all numbers of a table, in SI units; beyond it sums and squares leave what a page can hold."""


class Kind(enum.Enum):
    """What a table holds; the value names its columns of numbers beside `t`."""

    STATES = (*STATE_NAMES, *SIGMA_NAMES)
    PREDICTIONS = ("x", "y", "z", "sigma_x", "sigma_y", "sigma_z")


@dataclass(frozen=True, eq=False)
class ResultTable:
    """A table of results.

    Attributes:
        path: of the file.  kind: of the table.
        rows: where the rows of each track are, in the order in which the tracks first appear.
        values: (rows, 1 + c) t in s and the columns of the kind, rows of a track together and in order of time.
    """

    path: Path
    kind: Kind
    rows: Mapping[str, slice]
    values: Array

    def of(self, name: str) -> Array:
        """(k, 1 + c) rows of a track in the units of the columns; none where the table has no such track."""
        return self.values[self.rows.get(name, slice(0))]


def kind_of(columns: Sequence[str]) -> Kind | None:
    """What a table with these columns holds; None where it is no table of results."""
    for kind in Kind:
        if set(KEYS) | set(kind.value) <= set(columns):
            return kind
    return None


def columns_of(path: Path) -> list[str]:
    """The names of a table's columns.

    Raises: ValueError: the file cannot be read as the table that its ending promises.
    """
    if path.suffix.lower() == ".parquet":
        with library_reads(path, "Parquet", "Write it again."):
            about = pq.read_metadata(path)
            check_unpacked(path, 8 * about.num_rows * about.num_columns)
            return list(about.schema.to_arrow_schema().names)
    try:
        with path.open(encoding="utf-8") as lines:
            return [name.strip().strip('"') for name in lines.readline().rstrip("\r\n").split(",")]
    except UnicodeDecodeError:
        raise ValueError(f"{path} must be a CSV table in UTF-8; got other bytes. Write it again.") from None


def read_table(path: Path, kind: Kind) -> ResultTable:
    """Reads the columns of a kind.

    Raises: ValueError: no rows, a cell that is no number, or a stamp that is not finite.
    """
    names = [*KEYS, *kind.value]
    types = {"trajectory": pa.string()} | dict.fromkeys(names[1:], pa.float64())
    try:
        if path.suffix.lower() == ".parquet":
            found = pq.read_table(path, columns=names).cast(pa.schema(list(types.items())))
        else:
            options = pa_csv.ConvertOptions(
                column_types=types, include_columns=names, strings_can_be_null=False, null_values=["", "nan", "NaN"]
            )
            found = pa_csv.read_csv(path, convert_options=options)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} must hold a number in each cell; {one_line(error)[:160]}. Correct it.") from None
    values = np.column_stack([found[name].to_numpy().astype(np.float64) for name in names[1:]])
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
    keys = found["trajectory"].combine_chunks().dictionary_encode()
    codes = keys.indices.to_numpy().astype(np.int64)
    order = np.lexsort((values[:, 0], codes))
    counts = np.bincount(codes, minlength=len(keys.dictionary))
    ends = np.cumsum(counts).tolist()
    rows = map(slice, [0, *ends], ends)
    return ResultTable(path, kind, dict(zip(keys.dictionary.to_pylist(), rows, strict=True)), values[order])
