"""Reads the rows of a track table block by block, from CSV or Parquet, with bounded memory."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.checks import one_line, shown
from ballfg.files.damaged import MAX_LINE
from ballfg.files.parquet import open_parquet
from ballfg.files.spreadsheet import bare
from ballfg.tracks import csv_files

KEY = "trajectory"
VALUES = ("t", "x", "y", "z")
SIGMAS = ("sigma_x", "sigma_y", "sigma_z")

# The CSV reader reads up to some 32 blocks ahead: small blocks keep that below 10 MB, at the same speed. A line must
# fit into one.
_CSV_BLOCK = MAX_LINE  # bytes of text a block
_PARQUET_BLOCK = 1 << 14  # rows a block


@dataclass(frozen=True)
class Block:
    """Consecutive rows of the file."""

    start: int  # number of the first row, counted from 0 at the first row of data
    names: list[str | None]  # the distinct trajectory names of the block; None for an empty cell of a Parquet file
    codes: NDArray[np.int32]  # (n,) index into `names` for each row
    values: Array  # (n, 4) t, x, y, z in s and m, or (n, 7) with the sigmas in m


class RowSource(ABC):
    """A track table that can be read repeatedly, in blocks. Raises: ValueError: a missing or repeated column."""

    def __init__(self, path: Path, header: Sequence[str]) -> None:
        csv_files.check_header(path, header, (KEY, *VALUES), (KEY, *VALUES, *SIGMAS))
        present = [name for name in SIGMAS if name in header]
        if present and len(present) < len(SIGMAS):
            absent = ", ".join(name for name in SIGMAS if name not in present)
            problem = f"{path}: sigma columns must be all three or none; {absent} missing, got {', '.join(present)}"
            raise ValueError(f"{problem}. Add the missing ones or drop the others.")
        self.path = path
        self.columns = [*VALUES, *present]
        self.ignored = [name for name in header if name not in (KEY, *self.columns)]

    @abstractmethod
    def blocks(self) -> Iterator[Block]:
        """Reads the file from its start.

        Raises: ValueError: a cell or a row that cannot be read; the message names line and column.
        """

    def stamp(self) -> tuple[int, int]:
        """Size (bytes) and modification time (ns) of the file."""
        status = self.path.stat()
        return status.st_size, status.st_mtime_ns

    @abstractmethod
    def where(self, *rows: int) -> str:
        """The file and the place of these rows (counted from 0), numbered for a reader of the file."""


class CsvRows(RowSource):
    """`tracks.csv`. Empty lines are skipped."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, csv_files.read_header(path))

    def blocks(self) -> Iterator[Block]:
        """Reads the file from its start; see RowSource."""
        convert = csv_files.convert_options([KEY], self.columns)
        options = pa_csv.ReadOptions(block_size=_CSV_BLOCK, use_threads=False)
        start = 0
        try:
            with pa_csv.open_csv(self.path, read_options=options, convert_options=convert) as reader:
                for batch in reader:
                    block = _block(batch, start)
                    yield replace(block, names=[None if name is None else bare(name) for name in block.names])
                    start += batch.num_rows
        except pa.ArrowInvalid as error:
            raise csv_files.explain(self.path, self.columns, str(error)) from None

    def where(self, *rows: int) -> str:
        """The file and the line numbers of these rows, counted from 1 with the header; see RowSource."""
        return f"{self.path}, {_counted('line', csv_files.lines_of_rows(self.path, rows))}"


class ParquetRows(RowSource):
    """`tracks.parquet`."""

    def __init__(self, path: Path) -> None:
        with open_parquet(path) as file:
            schema = file.schema.to_arrow_schema()  # without the dictionaries of texts
        super().__init__(path, schema.names)
        for name in self.columns:
            kind = schema.field(name).type
            if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_decimal(kind)):
                what = f"{path}, column {shown(name)}: must hold numbers; got type {kind}"
                raise ValueError(f"{what}. Convert it to float64 (SI units).")

    def blocks(self) -> Iterator[Block]:
        """Reads the file from its start; see RowSource."""
        names = [KEY, *self.columns]
        start = 0
        try:
            with open_parquet(self.path) as file:
                for batch in file.iter_batches(_PARQUET_BLOCK, columns=names, use_threads=False):
                    yield _block(batch.select(names), start)
                    start += batch.num_rows
        except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
            what = f"{self.path}: cannot be read as a table of tracks; {one_line(error)}"
            raise ValueError(f"{what}. Write it again.") from None

    def where(self, *rows: int) -> str:
        """The file and the numbers of these rows, counted from 1; see RowSource."""
        return f"{self.path}, {_counted('row', [row + 1 for row in rows])}"


def _block(batch: pa.RecordBatch, start: int) -> Block:
    names, codes = distinct(batch.column(0))
    columns = [column.cast(pa.float64()).to_numpy(zero_copy_only=False) for column in batch.columns[1:]]
    values = np.stack(columns, axis=1) if batch.num_rows else np.empty((0, len(columns)))
    return Block(start, names, codes, values)


def distinct(column: pa.Array) -> tuple[list[str | None], NDArray[np.int32]]:
    """The distinct texts of a column (n,), as they first appear, None for missing ones; (n,) the number of each."""
    if not pa.types.is_dictionary(column.type):
        column = column.cast(pa.string()).dictionary_encode()
    words = column.dictionary.cast(pa.string())
    places = column.indices.fill_null(len(words)).to_numpy(zero_copy_only=False)
    used, first, codes = np.unique(places, return_index=True, return_inverse=True)
    order = np.argsort(first)
    names = [words[int(place)].as_py() if place < len(words) else None for place in used[order]]
    return names, np.argsort(order)[codes].astype(np.int32)


def _counted(word: str, numbers: Sequence[int]) -> str:
    plural = word if len(numbers) == 1 else word + "s"
    return f"{plural} {' and '.join(map(str, numbers))}"
