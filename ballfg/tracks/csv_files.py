"""Reads headers and columns of CSV files, and explains errors with their line.

The fast reader reports a bad block, not the line of the file. A slow second pass runs only after an error, so that it
can afford to read the file cell by cell.
"""

import csv
import re
from collections.abc import Collection, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import IO

import pyarrow as pa
import pyarrow.csv as pa_csv

from ballfg.checks import LARGEST, did_you_mean, one_line, shown
from ballfg.files.damaged import MAX_LINE
from ballfg.files.spreadsheet import bare

_NUMBER = re.compile(r"\s*[+-]?(\d++\.?\d*+|\.\d++)([eE][+-]?\d+)?\s*", re.ASCII)
_NOT_FINITE = re.compile(r"\s*[+-]?(nan|inf|infinity)\s*", re.IGNORECASE)
MAX_HEADER = 1 << 16  # largest number of bytes in the line of column names


def is_number(cell: str) -> bool:
    """True for a decimal number with a point, such as 0.02 or 2e-2, of a plausible size (`LARGEST`)."""
    return _NUMBER.fullmatch(cell) is not None and abs(float(cell)) <= LARGEST


def read_header(path: Path) -> list[str]:
    """The column names of a CSV file. Raises: ValueError: empty, not UTF-8, or a line beyond `MAX_HEADER` bytes."""
    with path.open("rb") as file:
        first = re.split(rb"[\r\n]", file.read(MAX_HEADER + 1), maxsplit=1)[0]
    if not first.strip():
        raise ValueError(f"{path}: must begin with a line of column names; got an empty file or line. Add the header.")
    if len(first) > MAX_HEADER:
        problem = f"{path}, line 1: the line of column names must have at most {MAX_HEADER} bytes; it has more"
        raise ValueError(f"{problem}. Leave columns out, or put each row on a line of its own.")
    text = first.decode("utf-8-sig", errors="surrogateescape")
    if "\0" in text or _has_surrogate(text):
        raise _not_utf8(path, 1)
    return [bare(name) for name in next(csv.reader([text]))]


def check_header(path: Path, header: Sequence[str], required: Sequence[str], known: Collection[str]) -> None:
    """Refuses a header without a required column or with a known one repeated. Raises: ValueError: naming it."""
    text = ",".join(header)
    got = repr(text if len(text) <= 120 else text[:117] + "...")
    for name in required:
        if name not in header:
            expected = f"expected {','.join(required)}, " if len(required) > 1 else ""
            hint = did_you_mean(name, [other for other in header if other not in known])
            if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
                hint += " Cells must be separated by commas."
            raise ValueError(
                f"{path}: column {shown(name)} is missing; {expected}got {got}. Add or rename the column.{hint}"
            )
    for name in known:
        if list(header).count(name) > 1:
            raise ValueError(f"{path}: column {shown(name)} must appear once; got {got}. Rename one of them.")


def convert_options(texts: Sequence[str], numbers: Sequence[str]) -> pa_csv.ConvertOptions:
    """Makes the fast reader read these columns, in this order, without missing values."""
    text = pa.dictionary(pa.int32(), pa.string())
    return pa_csv.ConvertOptions(
        column_types={**dict.fromkeys(texts, text), **dict.fromkeys(numbers, pa.float64())},
        include_columns=[*texts, *numbers],
        null_values=[],
    )


def records(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The rows of data that are not empty, with their lines. Raises: ValueError: no UTF-8, a long line, a quote."""
    with path.open(encoding="utf-8-sig", errors="surrogateescape", newline="") as file:
        reader = csv.reader(_lines(path, file), strict=True)
        line = 1
        try:
            next(reader, None)
            while True:
                line = reader.line_num + 1
                cells = next(reader)
                if any(map(_has_surrogate, cells)):
                    raise _not_utf8(path, line)
                if cells:
                    yield line, [bare(cell) for cell in cells]
        except StopIteration:
            return
        except csv.Error as error:
            raise ValueError(
                f"{path}, line {line}: must be a row of comma-separated cells; {one_line(error)}. Check its quotes."
            ) from None


def _lines(path: Path, file: IO[str]) -> Iterator[str]:
    """The lines of a file. Raises: ValueError: a longer one than `MAX_LINE`."""
    for number, line in enumerate(iter(lambda: file.readline(MAX_LINE + 1), ""), 1):
        if len(line) > MAX_LINE:
            what = f"{path}, line {number}: must have at most {MAX_LINE} characters; it has more"
            raise ValueError(f"{what}. Put each row on a line of its own.")
        yield line


def lines_of_rows(path: Path, rows: Sequence[int]) -> list[int]:
    """The line numbers, from 1, of rows of data counted from 0."""
    first = enumerate(islice(records(path), max(rows) + 1))
    lines = {row: line for row, (line, _) in first if row in rows}
    return [lines.get(row, 0) for row in rows]


def explain(path: Path, numeric: Sequence[str], reason: str) -> ValueError:
    """The error for the first bad row of a file that the fast reader refused, or else its own reason."""
    header = read_header(path)
    line = 1
    try:
        for line, cells in records(path):
            problem = row_problem(header, numeric, cells)
            if problem:
                return ValueError(f"{path}, line {line}{problem}")
    except ValueError as error:
        return error
    if line == 1:
        return no_rows(path)
    return ValueError(f"{path}: must be a CSV table; {one_line(reason)}. Check quotes and separators.")


def no_rows(path: Path) -> ValueError:
    """The error for a table with only a header."""
    return ValueError(f"{path}: must hold tracks; got a header without rows. Add the measurements.")


def row_problem(header: list[str], numeric: Sequence[str], cells: list[str]) -> str | None:
    """The end of a message about a row with too few or too many cells, or without a required number."""
    if len(cells) != len(header):
        what = f": must have {len(header)} cells, one for each column of the header; got {len(cells)}"
        return f"{what}. Complete the line or delete it."
    for name in numeric:
        cell = cells[header.index(name)]
        if not _NUMBER.fullmatch(cell) and not _NOT_FINITE.fullmatch(cell):
            got = shown(cell) if cell.strip() else "an empty cell"
            what = f", column {shown(name)}: must be a number with a decimal point"
            return f"{what}; got {got}. Correct it or delete the line."
    return None


def _has_surrogate(cell: str) -> bool:
    return not cell.isascii() and any("\udc80" <= letter <= "\udcff" for letter in cell)


def _not_utf8(path: Path, line: int) -> ValueError:
    return ValueError(f"{path}, line {line}: must be UTF-8 text; got bytes of another encoding. Save it as UTF-8.")
