"""Parquet files that anybody may have written: opened when their metadata say that they can be read.

Texts are read as dictionaries: a name of 1 MB that stands in each row is one name in the file, and one in memory.
"""

from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from ballfg.checks import MAX_TEXT
from ballfg.files.damaged import MAX_COLUMNS, NUMBER, check_parts, check_unpacked, library_reads

MAX_FOOTER: Final = 16_000_000
"""Bytes of the metadata at the end of a file: some 100,000 pieces of columns."""
MAX_PIECES: Final = 100_000
"""Columns times groups of rows."""
_BUFFER: Final = 1 << 20
_REMEDY: Final = "Write it again."


def open_parquet(path: Path) -> pq.ParquetFile:
    """The file, of which nothing is decoded yet; columns of text will come as dictionaries.

    Small buffers and no reading ahead: a file with one huge group of rows is not held whole by those who read batches.

    Raises: ValueError: no Parquet file, or one that unpacks to far more than its size; the message names it.
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
    """The values of a column of texts, (n,), cut behind `MAX_TEXT`; rows of the same text share it."""
    chunks = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    found: list[Any] = []
    for chunk in chunks:
        if not pa.types.is_dictionary(chunk.type):
            found += chunk.to_pylist()
            continue
        words = [
            word.decode("utf-8", "replace")[:MAX_TEXT] if isinstance(word, bytes) else word[:MAX_TEXT]
            for word in chunk.dictionary.to_pylist()
        ]
        found += [None if code is None else words[code] for code in chunk.indices.to_pylist()]
    return found


def _unpacked(about: Any) -> int:
    """Bytes that all columns would take, by the metadata: those of the pages, and of a number for each value."""
    size = 0
    for group in range(about.num_row_groups):
        rows = about.row_group(group)
        for place in range(about.num_columns):
            piece = rows.column(place)
            size += max(piece.total_uncompressed_size, NUMBER * max(piece.num_values, rows.num_rows))
    return max(size, NUMBER * about.num_rows * about.num_columns)
