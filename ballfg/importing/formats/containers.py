"""Reads containers of tables of numbers: Parquet, Excel, npz, HDF5, MATLAB, ROS bags."""

import math
import pickle
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from struct import unpack
from typing import IO, Any, Final

import numpy as np

from ballfg.checks import listed, shown
from ballfg.files.damaged import FREE, NUMBER, check_parts, check_unpacked, library_reads, most_unpacked
from ballfg.importing.formats.nested import nested_tables
from ballfg.importing.formats.raw import RawTable, table_of
from ballfg.importing.formats.text_files import text_table

MAX_DEPTH: Final = 40  # largest depth of nested groups
MAX_MEMBERS: Final = 20_000  # files of an archive, or datasets and groups of an HDF5 file: four for each of 5,000 shots
EXCEL_FREE: Final = 1_000_000  # bytes of XML that any Excel file may hold: openpyxl reads some 2 MB a second
EXCEL_CELLS: Final = 25_000  # of any Excel file, plus one for each two bytes of its size: a number takes three or more
_HEADER: Final = 128  # bytes of a MATLAB file before the first variable; the last two give the byte order
_COMPRESSED: Final = 15  # the kind of a compressed variable
_BLOCK: Final = 1 << 20
_PLAIN: Final = "Save plain arrays of numbers with numpy.savez."


def read_parquet(path: Path) -> list[RawTable]:
    """The table of a Parquet file. Raises: ValueError: not a Parquet file."""
    import pyarrow as pa

    from ballfg.files.parquet import open_parquet

    with library_reads(path, "Parquet"), open_parquet(path) as file:
        table = file.read(use_threads=False).flatten()
        check_unpacked(path, sum(_copied(chunk) for column in table.columns for chunk in column.chunks))
        columns = _columns(pa, table)
    if any(isinstance(values, list) and values and isinstance(values[0], list) for values in columns.values()):
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        return nested_tables(rows, path.stem, str(path))
    return [table_of(path.stem, columns, str(path))]


def _columns(pa: Any, table: Any) -> dict[str, Any]:
    """The columns of an Arrow table by name: arrays of numbers and dates, else lists."""
    from ballfg.files.parquet import texts_of

    columns: dict[str, Any] = {}
    for field, column in zip(table.schema, table.columns, strict=True):
        if pa.types.is_timestamp(field.type):
            columns[field.name] = column.cast(pa.timestamp("ns", field.type.tz)).to_numpy().astype("datetime64[ns]")
        elif pa.types.is_integer(field.type) and column.null_count == 0:
            columns[field.name] = column.to_numpy()
        elif pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
            columns[field.name] = column.cast(pa.float64(), safe=False).to_numpy()
        else:
            columns[field.name] = texts_of(column)
    return columns


def _copied(array: Any, inside: bool = False) -> int:
    """Bytes of the texts within lists and structures, each of which becomes a separate copy."""
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = array.type
    if pa.types.is_dictionary(kind):
        return len(array) * (pc.max(pc.binary_length(array.dictionary)).as_py() or 0) if inside else 0
    if pa.types.is_struct(kind):
        return sum(_copied(part, True) for part in array.flatten())
    if pa.types.is_map(kind):
        return _copied(array.keys, True) + _copied(array.items, True)
    return _copied(array.values, True) if pa.types.is_nested(kind) else 0


def read_excel(path: Path) -> list[RawTable]:
    """The tables of an Excel file, one per sheet. Raises: ValueError: no openpyxl, or not an Excel file."""
    import csv
    import io

    openpyxl = _imported("openpyxl", "excel", path)
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} must be an Excel file (.xlsx); it is none. Save it again as .xlsx or CSV.")
    with library_reads(path, "Excel"), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        check_parts(path, "files within it", len(members), MAX_MEMBERS)
        check_unpacked(path, sum(member.file_size for member in members), EXCEL_FREE)
    sheets: dict[str, str] = {}
    left = EXCEL_CELLS + path.stat().st_size // 2
    with library_reads(path, "Excel"):
        book = openpyxl.load_workbook(io.BytesIO(path.read_bytes()), read_only=True, data_only=True)
        for sheet in book.worksheets:
            sheet.reset_dimensions()  # rows end at their last cell, whatever size the sheet declares
            rows = list(_rows(path, sheet, left))
            left -= sum(map(len, rows))
            width = max(map(len, rows), default=0)
            check_unpacked(path, sum(len(cell) for row in rows for cell in row) + width * len(rows))
            text = io.StringIO()
            csv.writer(text).writerows(row + [""] * (width - len(row)) for row in rows)
            sheets[sheet.title] = text.getvalue()
        book.close()
    found: list[RawTable] = []
    for title, written in sheets.items():
        try:
            found += [text_table(written, title, str(path))] if written else []
        except ValueError:  # a sheet of text beside the data is not a table
            continue
    if not found:
        raise ValueError(f"{path} must have a sheet with rows of numbers; got {listed(sheets)}. Add one.")
    return found


def _rows(path: Path, sheet: Any, most: int) -> Iterator[list[str]]:
    """The non-empty rows of a sheet, as text. Raises: ValueError: more cells than `most`."""
    count = 0
    for row in sheet.iter_rows(values_only=True):
        count += len(row)
        check_parts(path, "cells", count, most)
        cells = ["" if cell is None else cell.isoformat() if hasattr(cell, "isoformat") else str(cell) for cell in row]
        if any(cells):
            yield cells


def read_npz(path: Path) -> list[RawTable]:
    """The tables of an npz or npy file. Raises: ValueError: not one, or with Python objects."""
    with library_reads(path, "npz or npy", _PLAIN):
        size = _array_bytes(path)
    check_unpacked(path, size)
    with library_reads(path, "npz or npy", _PLAIN):
        loaded = np.load(path, allow_pickle=False)
        content: Any = loaded if isinstance(loaded, np.ndarray) else {key: loaded[key] for key in loaded.files}
        for array in [content] if isinstance(content, np.ndarray) else content.values():
            if array.dtype.kind == "U" and array.nbytes:
                codes = np.atleast_1d(array).astype(array.dtype.newbyteorder("=")).view(np.uint32)
                if codes.max() > sys.maxunicode:  # numpy would make text of it that Python cannot hold
                    raise ValueError("a text has code points that there are not")
    return nested_tables(content, path.stem, str(path))


def read_hdf5(path: Path) -> list[RawTable]:
    """The tables of an HDF5 file: datasets and groups of columns. Raises: ValueError: no h5py, or no HDF5 file."""
    h5py = _imported("h5py", "hdf5", path)
    with library_reads(path, "HDF5"), h5py.File(path, "r") as file:
        content = _Group(h5py, path).content(file, 0)
    return nested_tables(content, path.stem, str(path))


def read_matlab(path: Path) -> list[RawTable]:
    """The tables of a MATLAB file of any version. Raises: ValueError: not one, or version 7.3 without h5py."""
    child = Path(__file__).with_name("matlab_child.py")
    with library_reads(path, "MATLAB"):
        _check_packed(path)
        command = [sys.executable, "-P", str(child), str(path.absolute()), str(most_unpacked(path))]
        done = subprocess.run(command, capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode("utf-8", "replace").strip().splitlines()
            raise ValueError(said[-1] if done.returncode > 0 and said else "its parts have sizes that cannot be")
        outcome, content = pickle.loads(done.stdout)  # from this project's own process
        if outcome == "error":
            raise ValueError(content)
    if outcome == "too large":
        check_unpacked(path, content)
    return read_hdf5(path) if outcome == "hdf5" else nested_tables(content, path.stem, str(path))


def _check_packed(path: Path) -> None:
    """Counts the unpacked bytes of a version 5 file (MathWorks, MAT-File Format, level 5). Raises: ValueError."""
    with path.open("rb") as file:
        order = {b"IM": "<II", b"MI": ">II"}.get(file.read(_HEADER)[-2:])
        size = 0
        while order and len(tag := file.read(8)) == 8:
            kind, length = unpack(order, tag)
            if kind != _COMPRESSED:
                file.seek(length, 1)
                continue
            packed, inflate = file.read(length), zlib.decompressobj()
            while packed and not inflate.eof:
                size += len(inflate.decompress(packed, _BLOCK))
                check_unpacked(path, size)
                packed = inflate.unconsumed_tail


def read_bag(path: Path, topic: str | None) -> list[RawTable]:
    """The positions of one topic of a ROS 2 bag, in s from its first message. Raises: ValueError: none, or several."""
    from ballfg.live.sources.bag import bag_samples

    samples = list(bag_samples(path, topic))
    if not samples:
        raise ValueError(f"{path} must hold positions; the topic has no message. Choose another with --topic.")
    if any(len(sample.positions) > 1 for sample in samples):
        raise ValueError(f"{path}: a message holds several points. Choose a topic of one ball with --topic.")
    positions = np.array([sample.positions[0] for sample in samples])
    columns: dict[str, Any] = {"t [s]": np.array([sample.time for sample in samples])}
    columns |= {f"{axis} [m]": positions[:, i] for i, axis in enumerate("xyz")}
    sigmas = [sample.sigmas for sample in samples]
    if all(one is not None for one in sigmas):
        columns |= {f"sigma_{axis} [m]": np.array([one[0][i] for one in sigmas if one]) for i, axis in enumerate("xyz")}
    return [table_of(path.stem, columns, str(path))]


def _imported(package: str, extra: str, path: Path) -> Any:
    try:
        return import_module(package)
    except ImportError:
        what = f"{path} must be read by the package {package}; it is not installed"
        raise ValueError(f"{what}. Install it: pip install 'ballfg[{extra}]'.") from None


class _Group:
    """Reads the groups of an HDF5 file within bounds: links may form cycles, empty data may have any size."""

    def __init__(self, h5py: Any, path: Path) -> None:
        self._h5py, self._path = h5py, path
        self._size = 0
        self._seen: set[int | None] = set()

    def content(self, group: Any, depth: int) -> dict[str, Any]:
        """Arrays and numbers of a group, by name."""
        content: dict[str, Any] = {}
        plain = (str, int, float, np.integer, np.floating)
        content |= {key: value for key, value in group.attrs.items() if isinstance(value, plain)}
        if depth > MAX_DEPTH:
            raise ValueError(f"{self._path}: groups must be nested at most {MAX_DEPTH} deep. Write it flatter.")
        check_parts(self._path, "groups and datasets", len(self._seen) + len(group), MAX_MEMBERS)
        for key in group:
            if self._is_known(group, key):
                continue
            value = group.get(key)  # None for a link that leads nowhere
            if isinstance(value, self._h5py.Group):
                if not key.startswith("#"):  # MATLAB keeps the parts of cells there
                    content[key] = self.content(value, depth + 1)
            elif isinstance(value, self._h5py.Dataset) and value.shape is not None:
                content[key] = self._data(key, value)
        return content

    def _is_known(self, group: Any, key: str) -> bool:
        """True if another link has led there: else 40 groups had 2^40 ways. Raises: ValueError: a link to a file."""
        link = group.id.links.get_info(key.encode("utf-8", "surrogateescape"))
        if link.type not in (self._h5py.h5l.TYPE_HARD, self._h5py.h5l.TYPE_SOFT):
            raise ValueError(f"{self._path} must hold its data itself; {shown(key)} is a link to another file.")
        place = link.u
        if link.type == self._h5py.h5l.TYPE_SOFT:
            value = group.get(key)
            place = None if value is None else self._h5py.h5o.get_info(value.id).addr
        known = place in self._seen
        self._seen.add(place)
        return known

    def _data(self, key: str, value: Any) -> Any:
        """The array of a dataset, after a count of its bytes and those of its largest chunk."""
        if value.external or value.is_virtual:
            raise ValueError(f"{self._path} must hold its data itself; those of {shown(key)} are in another file.")
        width = max(value.dtype.itemsize, NUMBER)
        self._size += max(value.size, math.prod(value.chunks or (1,))) * width
        check_unpacked(self._path, self._size)
        if not value.dtype.hasobject or value.ndim == 0 or value.size == 0:
            return value[()]
        # texts and lists of any length: many may be one in the file, and each becomes a separate copy
        parts, few = [], max(1, FREE * len(value) // (self._path.stat().st_size * value.size))
        for start in range(0, len(value), few):
            parts.append(value[start : start + few])
            self._size += sum(map(_length, parts[-1].ravel().tolist()))
            check_unpacked(self._path, self._size)
        return np.concatenate(parts)


def _length(value: Any) -> int:
    """Approximate number of bytes of a text, a list, or a row of them."""
    return sum(map(_length, value)) if isinstance(value, tuple) else getattr(value, "nbytes", 0) or len(str(value))


def _array_bytes(path: Path) -> int:
    """Number of bytes of the arrays in an npz or npy file, by their headers and the archive."""
    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            return _header_bytes(file)
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        check_parts(path, "arrays", len(members), MAX_MEMBERS)
        size = 0
        for member in members:
            with archive.open(member) as file:
                within = _header_bytes(file) if member.filename.endswith(".npy") else 0
            size += max(member.file_size, within)
        return size


def _header_bytes(file: IO[bytes]) -> int:
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = header(file)
    return math.prod(shape) * max(kind.itemsize, NUMBER)
