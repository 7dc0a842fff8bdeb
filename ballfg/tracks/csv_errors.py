"""Where and why a CSV file cannot be read.

The fast reader says that a block is bad, not which line of the file. This slow second look runs only when there
is an error to report, so that it can afford to read the file cell by cell.
"""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
_NOT_FINITE = re.compile(r"\s*[+-]?(nan|inf|infinity)\s*", re.IGNORECASE)
_HEADER_LIMIT = 1 << 16  # bytes


def is_number(cell: str) -> bool:
    """Whether a cell holds a finite decimal number with a point, such as 0.02 or 2e-2."""
    return _NUMBER.fullmatch(cell) is not None and math.isfinite(float(cell))


def one_line(error: object) -> str:
    """The text of an error on one line, without its full stop."""
    return " ".join(str(error).split()).rstrip(".")


def read_header(path: Path) -> list[str]:
    """The column names of a CSV file.

    Raises: ValueError: an empty file, or one that is not UTF-8 text.
    """
    with path.open("rb") as file:
        first = re.split(rb"[\r\n]", file.read(_HEADER_LIMIT), maxsplit=1)[0]
    if not first.strip():
        raise ValueError(f"{path}: must begin with a line of column names; got an empty file or line. Add the header.")
    try:
        text = first.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise _not_utf8(path, 1) from None
    if "\0" in text:
        raise _not_utf8(path, 1)
    return next(csv.reader([text]))


def records(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The rows of data with the number of the line on which each begins; empty lines are skipped.

    Raises: ValueError: text that is not UTF-8, or a quote that is never closed.
    """
    with path.open(encoding="utf-8-sig", errors="surrogateescape", newline="") as file:
        reader = csv.reader(file, strict=True)
        line = 1
        try:
            next(reader, None)
            while True:
                line = reader.line_num + 1
                cells = next(reader)
                if any(not cell.isascii() and _has_surrogate(cell) for cell in cells):
                    raise _not_utf8(path, line)
                if cells:
                    yield line, cells
        except StopIteration:
            return
        except csv.Error as error:
            raise ValueError(
                f"{path}, line {line}: must be a row of comma-separated cells; {one_line(error)}. Check its quotes."
            ) from None


def lines_of_rows(path: Path, rows: Sequence[int]) -> list[int]:
    """The line numbers, from 1, of rows of data counted from 0."""
    wanted = dict.fromkeys(rows, 0)
    last = max(rows)
    for row, (line, _) in enumerate(records(path)):
        if row in wanted:
            wanted[row] = line
        if row == last:
            break
    return [wanted[row] for row in rows]


def explain(path: Path, numeric: Sequence[str], reason: str) -> ValueError:
    """The error that names the first bad row of a file that the fast reader refused.

    Args:
        path: the file.
        numeric: the columns that must hold numbers.
        reason: the fast reader's own words, used if the second look finds nothing.
    """
    header = read_header(path)
    line = 1
    try:
        for line, cells in records(path):
            problem = _row_problem(header, numeric, cells)
            if problem:
                return ValueError(f"{path}, line {line}{problem}")
    except ValueError as error:
        return error
    if line == 1:
        return no_rows(path)
    return ValueError(f"{path}: must be a CSV table; {one_line(reason)}. Check quotes and separators.")


def no_rows(path: Path) -> ValueError:
    """The error for a table that has only a header."""
    return ValueError(f"{path}: must hold tracks; got a header without rows. Add the measurements.")


def _row_problem(header: list[str], numeric: Sequence[str], cells: list[str]) -> str | None:
    if len(cells) != len(header):
        return (
            f": must have {len(header)} cells, one for each column of the header; got {len(cells)}. "
            "Complete the line or delete it."
        )
    for name in numeric:
        cell = cells[header.index(name)]
        if not _NUMBER.fullmatch(cell) and not _NOT_FINITE.fullmatch(cell):
            got = f"got {cell!r}" if cell.strip() else "got an empty cell"
            return f", column {name!r}: must be a number with a decimal point; {got}. Correct it or delete the line."
    return None


def _has_surrogate(cell: str) -> bool:
    return any("\udc80" <= letter <= "\udcff" for letter in cell)


def _not_utf8(path: Path, line: int) -> ValueError:
    return ValueError(f"{path}, line {line}: must be UTF-8 text; got bytes of another encoding. Save it as UTF-8.")
