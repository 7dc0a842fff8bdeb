"""Bombs in archives of arrays: npz, npy, MATLAB, HDF5, Excel, safetensors."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

Write = Callable[[Path], object]
Bomb = tuple[str, str, Write]
ZEROS = 100_000_000
"""Numbers."""
CELL = '<c r="A1"><v>0</v></c>'


def _npz(array: np.ndarray, count: int = 1) -> Write:
    """An archive of arrays; they are written piece by piece, so that one of zeros takes no memory."""

    def write(path: Path) -> None:
        with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=1) as archive:
            for k in range(count):
                with archive.open(f"t{k}.npy", "w", force_zip64=True) as member:
                    np.save(member, array)

    return write


def _npy(shape: tuple[int, ...], kind: str) -> Write:
    """A header without its array."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})

    return write


def _long_npy_header(path: Path) -> None:
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + b"1," * 20_000_000 + b"), }\n"
    path.write_bytes(b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text)


def _matlab(content: dict[str, object]) -> Write:
    def write(path: Path) -> None:
        import scipy.io

        scipy.io.savemat(path, content, do_compression=True)

    return write


def _matlab_cells(path: Path) -> None:
    cells = np.empty(20, dtype=object)
    cells[:] = [np.zeros(5_000_000)] * 20
    _matlab({"shots": cells})(path)


def _hdf5(fill: Callable[[object], object]) -> Write:
    def write(path: Path) -> None:
        import h5py

        with h5py.File(path, "w") as file:
            fill(file)

    return write


def _doubling_links(file: object) -> None:
    """Two links from each group to the next: 2^38 ways to the last one."""
    group = file
    for _ in range(38):
        below = group.create_group("a")  # type: ignore[attr-defined]
        group["b"] = below  # type: ignore[index]
        group = below


def _large_chunk(file: object) -> None:
    """Nine numbers in a chunk of half a gigabyte."""
    file.create_dataset(  # type: ignore[attr-defined]
        "t", (9,), "f8", chunks=(60_000_000,), maxshape=(None,), compression="gzip", data=np.zeros(9)
    )


def _elsewhere(file: object) -> None:
    """Data that are another file's."""
    import h5py

    file["t"] = h5py.ExternalLink("/dev/zero", "/t")  # type: ignore[index]


def _members(part: str, repeats: int, before: str, after: str) -> Write:
    """An Excel file whose sheet repeats a part."""

    def write(path: Path) -> None:
        import openpyxl

        book = openpyxl.Workbook()
        book.active.append([1, 2, 3])
        content = io.BytesIO()
        book.save(content)
        with ZipFile(content) as whole, ZipFile(path, "w", ZIP_DEFLATED) as archive:
            for name in whole.namelist():
                if not name.endswith("sheet1.xml"):
                    archive.writestr(name, whole.read(name))
            with archive.open("xl/worksheets/sheet1.xml", "w", force_zip64=True) as sheet:
                sheet.write(before.encode())
                for _ in range(repeats // 1000):
                    sheet.write((part * 1000).encode())
                sheet.write(after.encode())

    return write


def _sheet(part: str, repeats: int) -> Write:
    start = '<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"><sheetData>'
    return _members(part, repeats, start, "</sheetData></worksheet>")


def _header(path: Path, count: int) -> None:
    text = "{" + ",".join(f'"{k:08d}":{{"dtype":"F32","shape":[0],"data_offsets":[0,0]}}' for k in range(count)) + "}"
    path.write_bytes(struct.pack("<Q", len(text)) + text.encode())


def _length_alone(path: Path) -> None:
    path.write_bytes(struct.pack("<Q", 90_000_000) + b" " * 90_000_000)


ARRAYS: dict[str, Bomb] = {
    "npz/zeros": ("import", "x.npz", _npz(np.broadcast_to(0.0, (ZEROS // 4, 4)))),
    "npz/bytes": ("import", "x.npz", _npz(np.broadcast_to(np.uint8(0), (ZEROS, 4)))),
    "npz/arrays without end": ("import", "x.npz", _npz(np.zeros((4, 4)), 30_000)),
    "npz/shots without end": ("import", "x.npz", _npz(np.broadcast_to(0.0, (200_000, 3, 4)))),
    "npy/a header alone": ("import", "x.npy", _npy((10**12, 4), "<f8")),
    "npy/texts": ("import", "x.npy", _npy((3,), "<U500000000")),
    "npy/sides without end": ("import", "x.npy", _long_npy_header),
    "mat/zeros": ("import", "x.mat", _matlab({"t": np.zeros(ZEROS // 2)})),
    "mat/zeros in a structure": ("import", "x.mat", _matlab({"shot": {"t": np.zeros(ZEROS // 2)}})),
    "mat/zeros in cells": ("import", "x.mat", _matlab_cells),
    "mat/bytes in a structure": ("import", "x.mat", _matlab({"s": {"t": np.zeros(2 * ZEROS, np.uint8)}})),
    "h5/nothing written": ("import", "x.h5", _hdf5(lambda f: f.create_dataset("t", (10**9, 4), "f8", chunks=(999, 4)))),
    "h5/zeros": ("import", "x.h5", _hdf5(lambda f: f.create_dataset("t", data=np.zeros(9**8), compression="gzip"))),
    "h5/one large chunk": ("import", "x.h5", _hdf5(_large_chunk)),
    "h5/links that double": ("import", "x.h5", _hdf5(_doubling_links)),
    "h5/groups without end": ("import", "x.h5", _hdf5(lambda f: [f.create_group(f"g{k}") for k in range(40_000)])),
    "h5/another file": ("import", "x.h5", _hdf5(_elsewhere)),
    "xlsx/cells": ("import", "x.xlsx", _sheet(f"<row>{CELL * 20}</row>", 1_000_000)),
    "xlsx/cells of a small file": ("import", "x.xlsx", _sheet(f"<row>{CELL * 4}</row>", 300_000)),
    "xlsx/cells within the size": ("import", "x.xlsx", _sheet(f"<row>{CELL * 4}</row>", 10_000)),
    "xlsx/a long word": ("import", "x.xlsx", _sheet("a" * 1000, 200_000)),
    "safetensors/header": ("weights", "x.safetensors", lambda path: _header(path, 1_000_000)),
    "safetensors/a length alone": ("weights", "x.safetensors", _length_alone),
}  # fmt: skip
