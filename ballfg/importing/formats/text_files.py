"""Reads tables of text, CSV, TSV and similar, with any separator, decimal sign, header and comments."""

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ballfg.checks import one_line
from ballfg.files.damaged import MAX_LINE, whole_content
from ballfg.files.spreadsheet import bare
from ballfg.importing.formats.raw import MISSING, WITH_UNIT, RawTable, table_of
from ballfg.importing.formats.vendors import capture_table
from ballfg.importing.names import unit_of_text

SEPARATORS: Final = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_COMMENTS: Final = ("#", "%", "//")
_NUMBER: Final = re.compile(r"^[-+]?(\d++\.?\d*+|\.\d++)([eE][-+]?\d++)?$")
_DECIMAL_COMMA: Final = re.compile(r"^[-+]?(?:\d{1,3}(?:\.\d{3})+|\d*),\d+([eE][-+]?\d++)?$")  # 1.234,5 too
_POINTS_IN_THOUSANDS: Final = re.compile(r"^[-+]?\d{1,3}(?:\.\d{3})+(?:,\d+)?$")
_COMMAS_IN_THOUSANDS: Final = re.compile(r"^[-+]?\d{1,3}(?:,\d{3})+(?:\.\d+)?$")
_LOOK: Final = 200  # number of lines for finding the separator
_HEAD: Final = 4096  # number of bytes at the beginning for recognising text
_CONTROL: Final = 0.02  # share of control characters from which a file is not text


def decoded(path: Path) -> str:
    """The text of a file, whatever its encoding. Raises: ValueError: empty, or not text."""
    with path.open("rb") as file:
        _text(path, file.read(_HEAD))  # a file that is not text may be of any size
    text = _text(path, whole_content(path))
    if not text.strip():
        raise ValueError(f"{path} must hold rows of numbers; the file is empty. Export it again.")
    return text.replace("\u2212", "-")  # the sign that typesetters and some spreadsheets write


def _text(path: Path, content: bytes) -> str:
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", "replace")
    head = content[:_HEAD]
    if b"\0" in head or sum(byte < 32 and byte not in b"\t\r\n\f" for byte in head) > _CONTROL * len(head):
        raise ValueError(
            f"{path} must be text, JSON, Parquet, Excel, HDF5, npz, MATLAB or a ROS bag; it is binary and begins with "
            f"{content[:8]!r}. Export it as CSV."
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def text_table(text: str, name: str, source: str) -> RawTable:
    """The table in a text. Raises: ValueError: no rows of numbers, or an enormous cell."""
    try:
        return capture_table(text, name, source) or _text_table(text, name, source)
    except csv.Error as error:  # more than 131,072 characters without a separator
        what = f"{source} must hold rows of numbers: a time and x, y, z; {one_line(error)}"
        raise ValueError(f"{what}. Export the table as CSV.") from None


def _text_table(text: str, name: str, source: str) -> RawTable:
    lines = [line for line in text.splitlines() if line.strip()]
    longest = max(map(len, lines), default=0)
    if longest > MAX_LINE:
        what = f"{source} must have lines of at most {MAX_LINE} characters; one has {longest}"
        raise ValueError(f"{what}. Export the table as CSV, one row a line.")
    rows_of_text = [line for line in lines if not line.lstrip().startswith(_COMMENTS)]
    comments = [line for line in lines if line.lstrip().startswith(_COMMENTS)]
    separator = _separator(rows_of_text)
    rows = _cells(rows_of_text, separator)
    rows = _without_thousands(rows, _COMMAS_IN_THOUSANDS, ",", ".")
    comma = separator != "," or any(_DECIMAL_COMMA.match(cell) for row in rows[-5:] for cell in row)
    if comma and any(_DECIMAL_COMMA.match(cell) for row in rows for cell in row):
        plain = _without_thousands(rows, _POINTS_IN_THOUSANDS, ".", ",")
        rows = [[cell.replace(",", ".") if _DECIMAL_COMMA.match(cell) else cell for cell in row] for row in plain]
    start = _first_data_row(rows)
    if start is None:
        shown = rows_of_text[0][:60] if rows_of_text else comments[0][:60]
        raise ValueError(
            f"{source} must hold rows of numbers: a time and x, y, z; its text begins with {shown!r} and has no such "
            "rows. Export the table as CSV with a header t,x,y,z."
        )
    width = Counter(len(row) for row in rows[start : start + _LOOK]).most_common(1)[0][0]
    header = [row for row in rows[:start] if len(row) == width]
    if not header and comments:
        header = _header_in_comment(comments[-1], separator, width)
    data = [row for row in rows[start:] if len(row) == width]
    names = [bare(one) for one in _joined(header, width)] if header else [str(i) for i in range(width)]
    columns = {one: [bare(cell) for cell in cells] for one, cells in zip(names, zip(*data, strict=True), strict=True)}
    table = table_of(name, columns, source, bool(header))
    if len(rows) - start > len(data):
        table.notes.append(f"{len(rows) - start - len(data)} lines without {width} cells left out")
    return table


def _without_thousands(rows: list[list[str]], pattern: re.Pattern[str], mark: str, decimal: str) -> list[list[str]]:
    """Rows without the marks of thousands, where a number shows that they are: 1.234,5 or 1.234.567, then 1.234 too."""
    told = (cell for row in rows for cell in row if mark in cell and (decimal in cell or cell.count(mark) > 1))
    if not any(pattern.match(cell) for cell in told):
        return rows
    return [[cell.replace(mark, "") if pattern.match(cell) else cell for cell in row] for row in rows]


def _separator(lines: Sequence[str]) -> str:
    """The separator that gives most lines the same number of cells, most of them numbers."""
    best, most = ",", (-math.inf, 0.0)
    for separator in SEPARATORS:
        rows = _cells(lines[-_LOOK:], separator)
        widths = Counter(len(row) for row in rows)
        if not widths:
            continue
        width, count = widths.most_common(1)[0]
        score = (_numbers(rows), count / sum(widths.values()) if width > 1 else 0.0)
        if score > most:
            best, most = separator, score
    return best


def _numbers(rows: Sequence[Sequence[str]]) -> float:
    """Number of cells with numbers, less four for each with text: in 0,1;0,2 a comma would leave the cell 1;0.

    A separator with fewer numbers than rows does not count.
    """
    cells = [cell for row in rows for cell in row if cell.lower() not in MISSING]
    found = sum(1 for cell in cells if _NUMBER.match(cell) or _DECIMAL_COMMA.match(cell) or WITH_UNIT.match(cell))
    return found - 4 * (len(cells) - found) if found >= len(rows) else -math.inf


def _cells(lines: Sequence[str], separator: str) -> list[list[str]]:
    if separator == " ":
        return [line.split() for line in lines]
    found = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator)]
    trailing = bool(found) and all(row and row[-1] == "" for row in found)
    return [row[:-1] for row in found] if trailing else found


def _first_data_row(rows: Sequence[Sequence[str]]) -> int | None:
    for i, row in enumerate(rows):
        if sum(bool(_NUMBER.match(cell) or WITH_UNIT.match(cell)) for cell in row) >= min(3, max(2, len(row) - 1)):
            return i
        spread = sum(cell.lower() in MISSING or bool(_NUMBER.match(cell)) for cell in row)
        if i and len(row) > 2 and spread == len(row) and any(_NUMBER.match(cell) for cell in row):
            return i
    return None


def _header_in_comment(comment: str, separator: str, width: int) -> list[list[str]]:
    words = comment.lstrip("#%/ ")
    for candidate in (separator, " ", ",", "\t", ";"):
        cells = _cells([words], candidate)[0]
        if len(cells) == width and not any(_NUMBER.match(cell) for cell in cells):
            return [cells]
    return []


def _joined(header: Sequence[Sequence[str]], width: int) -> list[str]:
    """One name for each column from headers of several lines; a line of units goes into brackets."""
    names: list[list[str]] = [[] for _ in range(width)]
    units = [""] * width
    for row in header:
        known = [unit_of_text(cell) is not None for cell in row]
        others = [cell for cell, is_unit in zip(row, known, strict=True) if not is_unit]
        if any(names) and sum(known) >= 2 and set(others) <= {"", "-", "1"}:
            units = list(row)
            continue
        for i, cell in enumerate(row):
            if cell and cell not in names[i]:
                names[i].append(cell)
    joined = [".".join(parts) or str(i) for i, parts in enumerate(names)]
    full = [f"{name} [{unit.strip('[]()')}]" if unit else name for name, unit in zip(joined, units, strict=True)]
    counts, unique = Counter[str](), []
    for name in full:
        counts[name] += 1
        unique.append(name if counts[name] == 1 else f"{name}#{counts[name]}")
    return unique
