"""A raw table holds named columns of numbers or text as found in a file, not interpreted."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ballfg.checks import MAX_TEXT, shown
from ballfg.files.damaged import MAX_COLUMNS

Column = NDArray[Any]  # (n,) int64, float64 or object (text)
MISSING: Final = (  # marks of a missing number, in lower case
    "", "-", "--", "?", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "missing", "lost", "inf", "-inf",
)  # fmt: skip
WITH_UNIT: Final = re.compile(r"^\s*([-+]?(?:\d++\.?\d*+|\.\d++)(?:[eE][-+]?\d++)?)\s*([^\W\d_]{1,3})\s*$")
"""A number with its unit, such as 12.5 mm."""
_MOSTLY: Final = 0.5  # least share of numbers among the cells of a numeric column


@dataclass
class RawTable:
    """One table of a source."""

    name: str  # name of the table in its file; the file's own name for a single table
    columns: dict[str, Column]  # by name, in the order of the file
    source: str = ""  # name of the file, for messages
    named: bool = True  # True if the columns have names of their own
    notes: list[str] = field(default_factory=list)  # omissions during reading
    texts: dict[str, Column] = field(default_factory=dict)
    """Columns as written, of numbers with some other cells, or of which several are one number: 1.1 and 1.10."""

    @property
    def doubts(self) -> dict[str, str]:
        """A sentence for each column of numbers with other cells that count as missing."""
        found = {}
        for name, text in self.texts.items():
            if wrong := [cell for cell in text.tolist() if cell.lower() not in MISSING and _real(cell) is None]:
                found[name] = f"column {shown(name)}: {len(wrong)} cells such as {shown(wrong[0])} count as missing"
        return found

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    @property
    def where(self) -> str:
        """File and table, for messages."""
        return self.source if self.name in ("", self.source) else f"{self.source} ({self.name})"


def table_of(name: str, columns: Mapping[str, Any], source: str = "", named: bool = True) -> RawTable:
    """A table from columns (n,) of anything; text that is numbers becomes numbers. Raises: ValueError: too many."""
    if len(columns) > MAX_COLUMNS:
        raise ValueError(f"{source} must have at most {MAX_COLUMNS} columns; got {len(columns)}. Leave some out.")
    read = [_column(label, values) for label, values in columns.items()]
    texts = {label: text for _, label, text in read if text is not None}
    return RawTable(name, {label: column for column, label, _ in read}, source, named, texts=texts)


def numbers(column: Column) -> NDArray[np.float64]:
    """The column as float64 (n,); NaN for text."""
    return column.astype(np.float64) if is_number(column) else np.full(len(column), np.nan)


def is_number(column: Column) -> bool:
    """True if the column holds numbers."""
    return column.dtype.kind in "iuf"


def _column(label: str, values: Any) -> tuple[Column, str, Column | None]:
    array = values if isinstance(values, np.ndarray) else _array(values)
    if array.dtype.kind in "mM":  # time differences and dates
        return array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64), f"{label} [ns]", None
    if array.dtype.kind in "bui":
        return array.astype(np.int64), label, None
    if array.dtype.kind == "f":
        return array.astype(np.float64), label, None
    return _from_text(label, [_cell(value) for value in array.tolist()])


def _array(values: Sequence[Any]) -> Column:
    held = list(values)
    kinds: dict[type, tuple[type, ...]] = {np.int64: (bool, int, np.integer), np.float64: (int, float, np.number)}
    for dtype, kind in kinds.items():
        if held and all(isinstance(value, kind) for value in held):
            with suppress(OverflowError):  # digits without end are not a measured number
                return np.array(held, dtype=dtype)
    return _objects(held)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip()
    text = value if isinstance(value, str) else value.isoformat() if hasattr(value, "isoformat") else str(value)
    return text[:MAX_TEXT].strip()


def _from_text(label: str, cells: list[str]) -> tuple[Column, str, Column | None]:
    """Numbers if most cells are numbers; whole numbers keep all their digits."""
    if any(len(cell) > 1 and cell[0] == "0" and cell.isdigit() for cell in cells):  # 007 is a name
        return _objects(cells), label, None
    present = [i for i, cell in enumerate(cells) if cell.lower() not in MISSING]
    for convert in (_whole, _real):
        parsed = [convert(cells[i]) for i in present]
        wrong = [cells[i] for i, value in zip(present, parsed, strict=True) if value is None]
        if present and not wrong:
            several = len({cells[i] for i in present}) > len(set(parsed))  # names, perhaps, that numbers cannot tell
            return _filled(len(cells), present, parsed), label, _objects(cells) if several else None
    if present and len(wrong) <= (1.0 - _MOSTLY) * len(present):
        return _filled(len(cells), present, parsed), label, _objects(cells)
    found = [WITH_UNIT.match(cells[i]) for i in present]  # such as "12.5 mm", with one unit in all of them
    units = {match[2] if match else "" for match in found}
    if present and len(units) == 1 and all(found):
        values = [float(match[1]) for match in found if match]
        return _filled(len(cells), present, values), f"{label} [{units.pop()}]", None
    return _objects(cells), label, None


def _objects(values: list[Any]) -> Column:
    made = np.empty(len(values), dtype=object)
    made[:] = values
    return made


def _filled(count: int, places: list[int], values: Sequence[float | int | None]) -> Column:
    if len(places) == count and all(isinstance(value, int) for value in values):
        return np.array(values, dtype=np.int64)
    column = np.full(count, np.nan)
    column[places] = [np.nan if value is None else float(value) for value in values]
    return column


def _whole(cell: str) -> int | None:
    try:
        value = int(cell)
    except ValueError:
        return None
    return value if "_" not in cell and abs(value) < 1 << 62 else None


def _real(cell: str) -> float | None:
    try:
        return float(cell) if "_" not in cell else None
    except ValueError:
        return None
