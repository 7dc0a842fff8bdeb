"""Reads the rows of a track table block by block, from CSV or Parquet, and groups them to trajectories.

If the rows of each trajectory are contiguous, the file is streamed: one block and one trajectory are in memory. If the
trajectories interleave, each pass first sorts the rows in a temporary file (8 bytes a value, 40 to 64 bytes a row, in
the system's temporary folder): a counting sort, because the scan has counted the rows of each trajectory. Either way,
memory grows with the longest trajectory, not with their number.
"""

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.checks import LARGEST, NAME_RULE, is_name, one_line, shown
from ballfg.files.damaged import MAX_LINE
from ballfg.files.parquet import open_parquet
from ballfg.files.spreadsheet import bare
from ballfg.tracks import csv_files
from ballfg.tracks.checks import MAX_SIGMA, MIN_SIGMA
from ballfg.tracks.csv_files import no_rows

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


@dataclass(frozen=True)
class RowGroup:
    """All rows of one trajectory, in the order of the file."""

    name: str

    rows: NDArray[np.int64]  # (n,) number of each row in the file, from 0
    values: Array  # (n, 4) or (n, 7), as in Block


@dataclass(frozen=True)
class Index:
    """The result of one scan of the file."""

    names: list[str]  # the trajectories in the order in which they first appear
    counts: NDArray[np.int64]  # (number of trajectories,) rows of each
    contiguous: bool  # True if the rows of each trajectory are contiguous
    stamp: tuple[int, int]  # size (bytes) and modification time (ns) of the scanned file


def scan(source: RowSource) -> Index:
    """Reads the file once, checks every cell, counts rows of trajectories. Raises: ValueError: no rows, a bad cell."""
    stamp = source.stamp()
    codes_of: dict[str, int] = {}
    counts: list[int] = []
    contiguous = True
    last = -1
    for block in source.blocks():
        check_cells(source, block)
        known = len(counts)
        codes = _global_codes(block, codes_of)
        counts.extend([0] * (len(codes_of) - known))
        # A run may only continue the last trajectory or begin the next new one.
        for start, end in _runs(codes):
            code = int(codes[start])
            contiguous &= code == last or counts[code] == 0
            counts[code] += end - start
            last = code
    if not counts:
        raise no_rows(source.path)
    return Index(list(codes_of), np.array(counts, dtype=np.int64), contiguous, stamp)


def groups(source: RowSource, index: Index) -> Iterator[RowGroup]:
    """The trajectories in the order of their first rows. Raises: ValueError: the file has changed since the scan."""
    if source.stamp() != index.stamp:
        raise ValueError(f"{source.path}: must not change while it is in use; it did. Call read_dataset again.")
    return _stream(source) if index.contiguous else _regroup(source, index)


def check_cells(source: RowSource, block: Block) -> None:
    """Refuses a block with a nameless row, a value that is not finite, or an invalid sigma."""
    for code, name in enumerate(block.names):
        if not name or not is_name(name):
            row = block.start + int(np.argmax(block.codes == code))
            problem = f"{source.where(row)}, column 'trajectory': must be {NAME_RULE}; got {shown(name or '')}"
            raise ValueError(f"{problem}. Fill in a name.")
    bad = ~(np.abs(block.values) <= LARGEST)
    sigmas = block.values[:, 4:]
    bad[:, 4:] |= (sigmas < MIN_SIGMA) | (sigmas > MAX_SIGMA)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        value = float(block.values[row, column])
        rule = "finite" if not np.isfinite(value) else f"at most {LARGEST:g} in size"
        remedy = "Delete the line: a missing sample needs no row."
        if column >= 4:
            rule = f"a standard deviation of {MIN_SIGMA:g} to {MAX_SIGMA:g} m"
            remedy = "Correct it, or drop the sigma columns."
        place = f"{source.where(block.start + row)}, column {shown(source.columns[column])}"
        raise ValueError(f"{place}: must be {rule}; got {value:g}. {remedy}")


def _global_codes(block: Block, codes_of: dict[str, int]) -> NDArray[np.int32]:
    """(n,) the trajectory's number for each row; new trajectories get the next numbers."""
    numbers = [codes_of.setdefault(str(name), len(codes_of)) for name in block.names]
    return np.array(numbers, dtype=np.int32)[block.codes]


def _runs(codes: NDArray[np.int32]) -> list[tuple[int, int]]:
    edges = [0, *(np.flatnonzero(np.diff(codes)) + 1).tolist(), len(codes)]
    return list(pairwise(edges)) if len(codes) else []


def _stream(source: RowSource) -> Iterator[RowGroup]:
    pieces = (
        RowGroup(str(block.names[block.codes[start]]), np.arange(start, end) + block.start, block.values[start:end])
        for block in source.blocks()
        for start, end in _runs(block.codes)
    )
    for name, run in groupby(pieces, key=lambda piece: piece.name):
        rows, values = zip(*((piece.rows, piece.values) for piece in run), strict=True)
        yield RowGroup(name, np.concatenate(rows), np.concatenate(values))


def _regroup(source: RowSource, index: Index) -> Iterator[RowGroup]:
    width = 1 + len(source.columns)
    codes_of = {name: code for code, name in enumerate(index.names)}
    position = (np.cumsum(index.counts) - index.counts).tolist()
    with tempfile.TemporaryFile(prefix="ballfg-") as file:
        for block in source.blocks():  # each row, its number and values, goes to its trajectory's place
            codes = _global_codes(block, codes_of)
            order = np.argsort(codes, kind="stable")
            table = np.column_stack([(block.start + order).astype(np.float64), block.values[order]])
            for start, end in _runs(codes[order]):
                code = int(codes[order[start]])
                file.seek(position[code] * width * 8)
                file.write(table[start:end].tobytes())
                position[code] += end - start
        file.seek(0)
        for name, count in zip(index.names, index.counts, strict=True):
            table = np.frombuffer(file.read(int(count) * width * 8), dtype=np.float64).reshape(-1, width)
            # A row number is exact in float64 up to 2**53.
            yield RowGroup(name, table[:, 0].astype(np.int64), table[:, 1:])
