"""Writes a result table as a stream, CSV or Parquet, and never leaves half a file under the final name."""

import csv
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from numpy.typing import ArrayLike

from ballfg.checks import check_path, shown
from ballfg.files.spreadsheet import NUMBER, QUOTED, guarded
from ballfg.files.whole_file import check_file, whole_file

ENDINGS = (".csv", ".parquet")
_BLOCK_ROWS = 1 << 16  # rows in memory before they are written; also the row group of a Parquet file


class TableWriter:
    """Writes a table block by block; the file takes its name only when the `with` block ends without an exception.

    Floats are written with enough digits to restore the same float64. Memory is bounded by a block. In CSV, a text that
    a spreadsheet would take for a formula (=, +, - or @ at its beginning, and no number) gets an apostrophe in front,
    which ballfg's readers remove; not in columns `plain`, which hold words of a format, such as +x.
    Messages call the path `name`.

    Example:
        with TableWriter("states.csv") as table:
            for track in dataset:
                table.write({"trajectory": track.name, "t": track.times, "x": track.positions[:, 0]})

    Raises: ValueError: another ending than .csv or .parquet, or a path that is a folder. FileNotFoundError: the
        folder of the path does not exist.
    """

    def __init__(self, path: str | os.PathLike[str], *, plain: Sequence[str] = (), name: str = "path") -> None:
        self.path, self.plain = check_path(name, path), frozenset(plain)
        if self.path.suffix.lower() not in ENDINGS:
            raise ValueError(
                f"{name} must end in {' or '.join(ENDINGS)}; got {str(path)!r}. Choose the format by the ending."
            )
        check_file(self.path, name)
        self._file: BinaryIO | None = None
        self._parquet: pq.ParquetWriter | None = None
        self._schema: pa.Schema | None = None
        self._pending: list[pa.RecordBatch] = []
        self._pending_rows = 0

    def __enter__(self) -> "TableWriter":
        self._context = self._opened()
        return self._context.__enter__()

    def __exit__(self, *exception: Any) -> None:
        self._context.__exit__(*exception)

    @contextmanager
    def _opened(self) -> Iterator["TableWriter"]:
        """Gives the file its name when the rest is written; after an exception it is removed."""
        with whole_file(self.path, "path") as temporary, temporary.open("xb") as self._file:
            try:
                yield self
                if self._schema is None:
                    raise ValueError(
                        f"{self.path}: a table must have columns; nothing was written. Write at least one block."
                    )
                self._flush()
            finally:
                parquet, self._parquet, self._file, self._pending = self._parquet, None, None, []
                if parquet is not None:
                    parquet.close()

    def write(self, columns: Mapping[str, ArrayLike]) -> None:
        """Appends a block of rows.

        Args:
            columns: name -> (n,) numbers, in any unit, or text, the same n for all; a single number or text is
                repeated. The first block determines the names, their order and their types.
        Raises: ValueError: columns of different lengths, other names than in the first block, or values of another
            type. RuntimeError: outside a `with` block.
        """
        if self._file is None:
            raise RuntimeError("write must be called inside `with TableWriter(path) as table:`; it was not.")
        batch = _batch(columns)
        self._schema = self._schema or batch.schema
        self._pending.append(_conformed(batch, self._schema))
        self._pending_rows += batch.num_rows
        if self._pending_rows >= _BLOCK_ROWS:
            self._flush()

    def _flush(self) -> None:
        assert self._schema is not None
        assert self._file is not None
        table = pa.Table.from_batches(self._pending, self._schema).combine_chunks()
        if self.path.suffix.lower() == ".csv":
            # The library quotes the header and, if one text needs quotes, all texts; simple readers expect neither.
            if self._file.tell() == 0:
                header = io.StringIO()
                csv.writer(header, lineterminator="\n").writerow(map(guarded, table.column_names))
                self._file.write(header.getvalue().encode())
            for place, field in enumerate(table.schema):
                if pa.types.is_string(field.type) and field.name not in self.plain:
                    text = table.column(place)  # formulas get quoted; see `ballfg.files.spreadsheet`
                    formula = pc.match_substring_regex(text, QUOTED)
                    risky = pc.and_(formula, pc.invert(pc.match_substring_regex(text, NUMBER)))
                    quoted = pc.binary_join_element_wise("'", text, "")
                    table = table.set_column(place, field, pc.if_else(risky, quoted, text))
            texts = [column for column in table.columns if pa.types.is_string(column.type)]
            quotes = any(pc.any(pc.match_substring_regex(column, '[,;"\t\r\n]')).as_py() for column in texts)
            style = pa_csv.WriteOptions(include_header=False, quoting_style="needed" if quotes else "none")
            pa_csv.write_csv(table, self._file, style)
        else:
            if self._parquet is None:
                self._parquet = pq.ParquetWriter(self._file, self._schema)
            self._parquet.write_table(table)
        self._pending, self._pending_rows = [], 0


def _batch(columns: Mapping[str, ArrayLike]) -> pa.RecordBatch:
    """One block after checks of names, lengths and shapes."""
    if not columns:
        raise ValueError("columns must name at least one column; got none. Pass name -> values.")
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    for name, array in arrays.items():
        if array.ndim > 1:
            what = f"columns[{shown(name)}] must have shape (n,); got {array.shape}"
            raise ValueError(f"{what}. Pass one column at a time.")
    lengths = {name: len(array) for name, array in arrays.items() if array.ndim == 1}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns must have one length; got {lengths}. Pass one value per row.")
    count = next(iter(lengths.values()), 1)
    return pa.RecordBatch.from_pydict({name: _arrow(name, array, count) for name, array in arrays.items()})


def _arrow(name: str, array: np.ndarray, count: int) -> pa.Array:
    if array.dtype.kind == "f":
        array = array.astype(np.float64)
    elif array.dtype.kind in "iu":
        array = array.astype(np.int64)
    elif array.dtype.kind in "OU":
        wrong = [value for value in array.ravel().tolist() if not isinstance(value, str)]
        if wrong:
            raise ValueError(f"columns[{shown(name)}] must hold numbers or text; got {shown(wrong[0])}. Convert it.")
        array = array.astype(object)
    elif array.dtype.kind != "b":
        raise ValueError(f"columns[{shown(name)}] must hold numbers or text; got dtype {array.dtype}. Convert it.")
    kind = pa.string() if array.dtype.kind == "O" else None
    if array.ndim == 0:
        return pa.repeat(pa.scalar(array.item(), type=kind or pa.from_numpy_dtype(array.dtype)), count)
    return pa.array(array, type=kind)


def _conformed(batch: pa.RecordBatch, schema: pa.Schema) -> pa.RecordBatch:
    """The block with the first block's types; whole numbers may be in a column of floats."""
    if batch.schema.names != schema.names:
        problem = f"columns must be those of the first block, {schema.names}; got {batch.schema.names}"
        raise ValueError(f"{problem}. Write the same columns in each block.")
    for name, got, want in zip(schema.names, batch.schema.types, schema.types, strict=True):
        if got != want and not (pa.types.is_integer(got) and pa.types.is_floating(want)):
            problem = f"columns[{shown(name)}] must be {want} as in the first block; got {got}"
            raise ValueError(f"{problem}. Convert it, or write floats from the start.")
    return batch if batch.schema == schema else batch.cast(schema)
