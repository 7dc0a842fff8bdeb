"""Opens untrusted Parquet files after a check of their metadata.

Texts are read as dictionaries: a name of 1 MB in each row is one name in the file, and one in memory.
"""

from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from ballfg.checks import MAX_TEXT
from ballfg.files.damaged import MAX_COLUMNS, NUMBER, check_parts, check_unpacked, library_reads

MAX_FOOTER: Final = 16_000_000  # bytes of the metadata at a file's end: some 100,000 pieces of columns
MAX_PIECES: Final = 100_000  # largest number of columns times groups of rows
_BUFFER: Final = 1 << 20
_REMEDY: Final = "Write it again."


def open_parquet(path: Path) -> pq.ParquetFile:
    """The file, not yet decoded; columns of text will come as dictionaries.

    Small buffers and no reading ahead: a reader of batches does not hold a file's huge group of rows whole.

    Raises: ValueError: not a Parquet file, or one that unpacks to far more than its size; the message names it.
    """
    with library_reads(path, "Parquet", _REMEDY):
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(size - 8, 0))
            footer, end = int.from_bytes(file.read(4), "little"), file.read(4)
        if end == b"PAR1" and footer < size:
            check_parts(path, "bytes of metadata", footer, MAX_FOOTER)
        about = pq.read_metadata(path)
        check_parts(path, "columns", about.num_columns, MAX_COLUMNS)
        check_parts(path, "pieces of columns", about.num_row_groups * max(about.num_columns, 1), MAX_PIECES)
        check_unpacked(path, _unpacked(about))
        schema = about.schema
        texts = [schema.column(i).path for i in range(len(schema)) if schema.column(i).physical_type == "BYTE_ARRAY"]
        return pq.ParquetFile(path, buffer_size=_BUFFER, pre_buffer=False, metadata=about, read_dictionary=texts)


def texts_of(column: pa.Array | pa.ChunkedArray) -> list[Any]:
    """The values of a column of texts, (n,), cut after `MAX_TEXT`; rows of the same text share it."""
    chunks = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    found: list[Any] = []
    for chunk in chunks:
        if not pa.types.is_dictionary(chunk.type):
            found += chunk.to_pylist()
            continue
        plain = chunk.dictionary.to_pylist()
        words = [(one.decode("utf-8", "replace") if isinstance(one, bytes) else one)[:MAX_TEXT] for one in plain]
        found += [None if code is None else words[code] for code in chunk.indices.to_pylist()]
    return found


def _unpacked(about: Any) -> int:
    """Number of bytes of all columns by the metadata: of the pages, plus a number for each value."""
    size = 0
    for rows in map(about.row_group, range(about.num_row_groups)):
        for piece in map(rows.column, range(about.num_columns)):
            size += max(piece.total_uncompressed_size, NUMBER * max(piece.num_values, rows.num_rows))
    return max(size, NUMBER * about.num_rows * about.num_columns)
