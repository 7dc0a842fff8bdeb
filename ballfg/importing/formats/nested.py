"""Finds tables in nested data: JSON, MATLAB structures, dicts and lists of arrays, groups of HDF5."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ballfg.importing.formats.raw import RawTable, table_of

_LEAST: Final = 3  # least number of rows of a list as a table; shorter lists are points or settings
_POINT: Final = 4  # largest number of coordinates of a point in one row
MAX_PARTS: Final = 100_000  # largest number of searched lists and mappings; each shot is one or a few


def nested_tables(content: Any, name: str, source: str) -> list[RawTable]:
    """All tables in nested data; a scalar beside one is a constant column. Raises: ValueError: too deep or many."""
    try:
        return _tables(content, name, _Source(source), {})
    except RecursionError:
        raise ValueError(f"{source} must be nested less deep; it has hundreds of levels. Write tables.") from None


@dataclass
class _Source:
    name: str
    parts: int = 0

    def add(self, parts: int) -> None:
        """Counts parts before they are searched. Raises: ValueError: too many."""
        self.parts += parts
        if self.parts > MAX_PARTS:
            raise ValueError(f"{self.name} must have at most {MAX_PARTS} lists of samples; got more. Split it.")


def _tables(content: Any, name: str, source: _Source, known: Mapping[str, Any]) -> list[RawTable]:
    if hasattr(content, "columns") and hasattr(content, "to_numpy"):  # a DataFrame of pandas or of another library
        labels = [".".join(filter(None, map(str, x))) if isinstance(x, tuple) else str(x) for x in content.columns]
        content = {label: np.asarray(content[name]) for label, name in zip(labels, content.columns, strict=True)}
    if isinstance(content, np.ndarray):
        return _of_array(content, name, source, known)
    if isinstance(content, Mapping):
        return _of_mapping(content, name, source, known)
    if isinstance(content, list | tuple) and len(content):
        return _of_list(list(content), name, source, known)
    return []


def _of_array(array: np.ndarray, name: str, source: _Source, known: Mapping[str, Any]) -> list[RawTable]:
    if array.dtype.names:
        return _of_mapping({key: array[key] for key in array.dtype.names}, name, source, known)
    if array.dtype.kind == "O":
        return _tables(array.tolist(), name, source, known)
    if array.ndim == 3:
        source.add(len(array))
        return [table for i, part in enumerate(array) for table in _of_array(part, f"{name}/{i:03d}", source, known)]
    if array.ndim != 2 or array.dtype.kind not in "iuf":
        return []
    if array.shape[0] <= 12 and array.shape[1] > 3 * array.shape[0]:  # one row a quantity
        array = array.T
    if array.shape[1] < 3 or len(array) < _LEAST:
        return []
    columns: dict[str, Any] = {str(i): column for i, column in enumerate(array.T)}
    return [_table(name, columns, source, {}, named=False)]


def _of_mapping(content: Mapping[Any, Any], name: str, source: _Source, known: Mapping[str, Any]) -> list[RawTable]:
    items = {str(key): value for key, value in content.items() if not str(key).startswith("__")}
    scalars = {key: value for key, value in items.items() if _is_scalar(value)}
    parts = {key: value for key, value in items.items() if key not in scalars}
    vectors = {label: column for key, value in parts.items() for label, column in _vectors(key, value).items()}
    lengths = [len(column) for column in vectors.values()]
    length = max(set(lengths), key=lambda one: (lengths.count(one), one)) if lengths else 0
    below = {**known, **scalars}
    columns = {label: column for label, column in vectors.items() if len(column) == length}
    if length >= _LEAST and len(columns) >= 2:
        return [_table(name, columns, source, below)]
    source.add(len(parts))
    named = {f"{name}/{key}" if name else key: value for key, value in parts.items()}
    return [table for key, value in named.items() for table in _tables(value, key, source, below)]


def _vectors(key: str, value: Any) -> dict[str, Any]:
    """The columns (n,) in a value: itself, the columns of points (n, 2..4), or the parts of a dict of vectors."""
    if isinstance(value, Mapping):
        parts = {str(k): v for k, v in value.items()}
        vectors = all(isinstance(v, list | np.ndarray) for v in parts.values())
        return {f"{key}.{k}": v for k, v in parts.items()} if vectors and set(parts) <= set("xyzXYZ") else {}
    try:
        array = value if isinstance(value, np.ndarray) else np.array(value)
    except ValueError:
        return {}
    if array.dtype.kind == "O" and array.ndim == 1 and not any(isinstance(v, list | dict | np.ndarray) for v in array):
        return {key: list(array)}
    if array.dtype.kind == "O" or array.dtype.names:
        return {}
    squeezed = array.reshape(-1) if array.ndim == 2 and 1 in array.shape else array
    if squeezed.ndim == 1:
        return {key: squeezed}
    if squeezed.ndim == 2 and squeezed.shape[0] in (2, 3) and squeezed.shape[1] > _POINT:
        squeezed = squeezed.T
    if squeezed.ndim != 2 or squeezed.shape[1] not in (2, 3):
        return {}
    return {f"{key}.{i}": column for i, column in enumerate(squeezed.T)}


def _of_list(items: list[Any], name: str, source: _Source, known: Mapping[str, Any]) -> list[RawTable]:
    if all(isinstance(item, Mapping) for item in items):
        rows = [_flat(item) for item in items]
        if len(items) >= _LEAST and all(row is not None for row in rows):
            labels = dict.fromkeys(label for row in rows for label in row or {})
            columns = {label: [(row or {}).get(label) for row in rows] for label in labels}
            return [_table(name, columns, source, known)]
    elif all(isinstance(item, list | tuple) and item and all(_is_scalar(v) for v in item) for item in items):
        widths = {len(item) for item in items}
        if len(widths) == 1 and len(items) >= _LEAST and widths != {1}:
            columns = {str(i): [item[i] for item in items] for i in range(widths.pop())}
            return [_table(name, columns, source, known, named=False)]
    parts = [(i, item) for i, item in enumerate(items) if not _is_scalar(item)]
    source.add(len(parts))
    return [table for i, item in parts for table in _tables(item, f"{name}/{i:03d}", source, known)]


def _flat(item: Mapping[str, Any], prefix: str = "") -> dict[str, Any] | None:
    """One row: nested dicts and points become columns; None for anything else."""
    row: dict[str, Any] = {}
    for key, value in item.items():
        label = f"{prefix}{key}"
        if _is_scalar(value):
            row[label] = value
        elif isinstance(value, Mapping):
            inner = _flat(value, f"{label}.")
            if inner is None:
                return None
            row |= inner
        elif (
            isinstance(value, list | tuple | np.ndarray) and len(value) <= _POINT and all(_is_scalar(v) for v in value)
        ):
            row |= {f"{label}.{i}": one for i, one in enumerate(value)}
        else:
            return None
    return row


def _is_scalar(value: Any) -> bool:
    return (
        value is None
        or isinstance(value, str | bytes | bool | int | float | np.generic)
        or (isinstance(value, np.ndarray) and value.ndim == 0)
        or hasattr(value, "isoformat")
    )


def _table(
    name: str, columns: Mapping[str, Any], source: _Source, known: Mapping[str, Any], named: bool = True
) -> RawTable:
    count = len(next(iter(columns.values())))
    constant = {
        key: [value.item() if isinstance(value, np.generic | np.ndarray) else value] * count
        for key, value in known.items()
        if key not in columns and value is not None
    }
    return table_of(name, {**columns, **constant}, source.name, named)
