"""Files that hold tables of numbers as such: Parquet, Excel, npz, HDF5, MATLAB, ROS bags."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from ballfg.importing.formats.nested import nested_tables
from ballfg.importing.formats.raw import RawTable, table_of
from ballfg.importing.formats.text_files import text_table


def read_parquet(path: Path) -> list[RawTable]:
    """The table of a Parquet file. Raises: ValueError: it is none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise _unreadable(path, "Parquet", error) from None
    columns: dict[str, Any] = {}
    for field in table.flatten().schema:
        column = table.flatten().column(field.name)
        if pa.types.is_list(field.type) or pa.types.is_fixed_size_list(field.type):
            columns[field.name] = column.to_pylist()
        elif pa.types.is_timestamp(field.type):
            columns[field.name] = column.cast(pa.timestamp("ns", field.type.tz)).to_numpy().astype("datetime64[ns]")
        elif pa.types.is_integer(field.type) and column.null_count == 0:
            columns[field.name] = column.to_numpy()
        elif pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
            columns[field.name] = column.cast(pa.float64()).to_numpy()
        else:
            columns[field.name] = column.to_pylist()
    rows: list[dict[str, Any]] = []
    if any(isinstance(values, list) and values and isinstance(values[0], list) for values in columns.values()):
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        return nested_tables(rows, path.stem, str(path))
    return [table_of(path.stem, columns, str(path))]


def read_excel(path: Path) -> list[RawTable]:
    """The tables of an Excel file, one a sheet. Raises: ValueError: no openpyxl, or not an Excel file."""
    try:
        import openpyxl
    except ImportError:
        raise ValueError(
            f"{path} must be read by the package openpyxl; it is not there. Install it: pip install 'ballfg[excel]'."
        ) from None
    import csv
    import io

    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} must be an Excel file (.xlsx); it is none. Save it again as .xlsx or CSV.")
    book = openpyxl.load_workbook(io.BytesIO(path.read_bytes()), read_only=True, data_only=True)
    found: list[RawTable] = []
    for sheet in book.worksheets:
        rows = [
            [
                ""
                if cell is None
                else cell.isoformat()
                if hasattr(cell, "isoformat")
                else repr(cell)
                if isinstance(cell, float)
                else str(cell)
                for cell in row
            ]
            for row in sheet.iter_rows(values_only=True)
        ]
        rows = [row for row in rows if any(row)]
        if not rows:
            continue
        text = io.StringIO()
        csv.writer(text).writerows(rows)
        try:
            found.append(text_table(text.getvalue(), sheet.title, str(path)))
        except ValueError:  # a sheet of text beside the data is no table
            continue
    book.close()
    if not found:
        raise ValueError(f"{path} must have a sheet with rows of numbers; got {', '.join(book.sheetnames)}. Add one.")
    return found


def read_npz(path: Path) -> list[RawTable]:
    """The tables of an npz or npy file. Raises: ValueError: not one, or it holds Python objects."""
    try:
        loaded = np.load(path, allow_pickle=False)
        content: Any = loaded if isinstance(loaded, np.ndarray) else {key: loaded[key] for key in loaded.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile):
        raise ValueError(
            f"{path} must be a whole npz or npy file of plain arrays; it is another file, cut off, or holds Python "
            "objects. Save arrays of numbers with numpy.savez."
        ) from None
    return nested_tables(content, path.stem, str(path))


def read_hdf5(path: Path) -> list[RawTable]:
    """The tables of an HDF5 file: compound or 2-D datasets, and groups of columns.

    Raises: ValueError: no h5py, or not an HDF5 file.
    """
    h5py = _h5py(path)
    try:
        with h5py.File(path, "r") as file:
            content = _group(h5py, file)
    except OSError as error:
        raise _unreadable(path, "HDF5", error) from None
    return nested_tables(content, path.stem, str(path))


def read_matlab(path: Path) -> list[RawTable]:
    """The tables of a MATLAB file of any version. Raises: ValueError: not one, or version 7.3 without h5py."""
    import scipy.io

    try:
        content = scipy.io.loadmat(path, simplify_cells=True)
    except NotImplementedError:  # version 7.3 is HDF5
        return read_hdf5(path)
    except (ValueError, TypeError, OSError) as error:
        raise _unreadable(path, "MATLAB", error) from None
    return nested_tables(content, path.stem, str(path))


def read_bag(path: Path, topic: str | None) -> list[RawTable]:
    """The positions of one topic of a ROS 2 bag, stamped in s from its first message.

    Raises: ValueError: no rosbags, no such topic, several topics, or several balls in one message.
    """
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


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise ValueError(
            f"{path} must be read by the package h5py; it is not installed. Install it: pip install 'ballfg[hdf5]'."
        ) from None
    return h5py


def _group(h5py: Any, group: Any) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in group.attrs.items():
        if isinstance(value, str | int | float | np.integer | np.floating):
            content[key] = value
    for key, value in group.items():
        if isinstance(value, h5py.Group):
            if not key.startswith("#"):  # MATLAB keeps the parts of cells there
                content[key] = _group(h5py, value)
        elif value.shape is not None:
            content[key] = value[()]
    return content


def _unreadable(path: Path, kind: str, error: Exception) -> ValueError:
    said = " ".join(str(error).split())[:120]
    return ValueError(f"{path} must be a whole {kind} file; {said}. Copy or export it again.")
