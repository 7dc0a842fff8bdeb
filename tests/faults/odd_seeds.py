"""Whole files with a content that no reader expects."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq


def write_odd(folder: Path) -> None:
    """Writes whole files with a content that no reader expects; they take the place of good ones."""
    folder.mkdir()
    for write in (_odd_parquet, _odd_hdf5, _odd_excel, _odd_matlab, _odd_arrays):
        write(folder)


def _odd_parquet(folder: Path) -> None:
    keys, numbers = pa.array(["a", "a", "b"]), pa.array([0.0, 1.0, 2.0])
    columns: dict[str, pa.Array] = {
        "decimal": pa.array([1, 2, 3]).cast(pa.decimal128(30, 5)), "text": pa.array(["1", "x", ""]),
        "none": pa.nulls(3), "list": pa.array([[1.0], [], [2.0, 3.0]]), "struct": pa.array([{"x": 1.0}] * 3),
        "date": pa.array([0, 1, 2], pa.timestamp("s")), "days": pa.array([0, 1, 2], pa.date32()),
        "far": pa.array([-(2**62), 0, 2**62], pa.timestamp("us")), "bool": pa.array([True, False, None]),
        "bytes": pa.array([b"\xff", b"", b"x"]), "words": keys.dictionary_encode(),
        "half": pa.array(np.array([1, 2, 3], np.float16)), "big": pa.array([2**64 - 1, 0, 1], pa.uint64()),
        "time": pa.array([1, 2, 3], pa.time64("ns")), "span": pa.array([1, 2, 3], pa.duration("ns")),
        "map": pa.array([[("a", 1)]] * 3, pa.map_(pa.string(), pa.int64())),
    }  # fmt: skip
    for name, column in columns.items():
        rest = {key: numbers for key in ("x", "y", "z")}
        pq.write_table(pa.table({"trajectory": keys, "t": column, **rest}), folder / f"stamps_{name}.parquet")
        pq.write_table(pa.table({"trajectory": column, "t": numbers, **rest}), folder / f"names_{name}.parquet")
    pq.write_table(pa.table({}), folder / "nothing.parquet")
    pq.write_table(pa.table({"t": pa.array([], pa.float64())}), folder / "no_rows.parquet")
    many = pa.array(np.zeros(40_000_000))  # 320 MB in memory, kilobytes in the file
    table = pa.table({name: many for name in ("t", "x", "y", "z")})
    pq.write_table(table, folder / "bomb.parquet", compression="zstd")


def _odd_hdf5(folder: Path) -> None:
    import h5py

    def one(name: str, fill: object) -> None:
        with h5py.File(folder / f"{name}.h5", "w") as file:
            fill(file)  # type: ignore[operator]

    one("nothing", lambda file: None)
    one("huge", lambda file: file.create_dataset("t", (10**9, 4), dtype="f8", chunks=(1000, 4)))
    one("huger", lambda file: file.create_dataset("t", (10**15,), dtype="f8", chunks=(1000,)))
    one(
        "many", lambda file: [file.create_dataset(f"t{k}", (10**7, 4), dtype="f8", chunks=(1000, 4)) for k in range(20)]
    )
    one("cycle", lambda file: file.create_group("a").__setitem__("b", file["/"]))
    one("soft", lambda file: file.__setitem__("a", h5py.SoftLink("/a")))
    one("outside", lambda file: file.__setitem__("a", h5py.ExternalLink("/etc/passwd", "/a")))
    one("text", lambda file: file.__setitem__("t", ["a", "b", "c"]))
    one("reference", lambda file: file.create_dataset("t", (3,), dtype=h5py.ref_dtype))
    one("ragged", lambda file: file.create_dataset("t", (3,), dtype=h5py.vlen_dtype(np.float64)))
    one("complex", lambda file: file.__setitem__("t", np.ones((4, 4), complex)))
    one("empty", lambda file: file.__setitem__("t", h5py.Empty("f")))
    one("compound", lambda file: file.__setitem__("t", np.zeros(4, [("t", "f8"), ("x", "f8", (3,)), ("n", "S3")])))
    one("five", lambda file: file.__setitem__("t", np.zeros((2, 2, 3, 3, 3))))

    def deep(file: object) -> None:
        group = file
        for _ in range(2000):
            group = group.create_group("g")  # type: ignore[attr-defined]

    one("deep", deep)


def _odd_excel(folder: Path) -> None:
    import openpyxl

    rows: Iterable[Iterable[object]]
    for name, rows in {
        "cells": [["t", "x", "y", "z"], [True, "=1/0", None, "#N/A"], ["1", 2, 3.5, "4"]],
        "nothing": [],
        "wide": [range(3000), range(3000), range(3000), range(3000)],
    }.items():
        book = openpyxl.Workbook()
        for row in rows:
            book.active.append(list(row))
        book.save(folder / f"{name}.xlsx")
    book = openpyxl.Workbook()
    book.active.cell(1_048_576, 16_384, 1.0)  # one cell at the far corner
    book.save(folder / "corner.xlsx")


def _odd_matlab(folder: Path) -> None:
    import scipy.io

    inner: dict[str, object] = {"t": np.arange(5.0)}
    for _ in range(40):
        inner = {"a": inner}
    for name, content in {
        "nothing": {}, "deep": inner, "text": {"t": "abc"}, "complex": {"t": np.ones((5, 4), complex)},
        "cells": {"t": np.array([1.0, "a", 2], dtype=object)}, "void": {"t": np.zeros((0, 4))},
    }.items():  # fmt: skip
        scipy.io.savemat(folder / f"{name}.mat", content)


def _odd_arrays(folder: Path) -> None:
    archive = ZipFile(folder / "bomb.npz", "w", ZIP_DEFLATED, compresslevel=1)
    with archive, archive.open("t.npy", "w", force_zip64=True) as member:
        np.save(member, np.zeros((50_000_000, 4)))  # 1.6 GB in memory, 7 MB in the file
    np.savez(folder / "pickled.npz", t=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.savez(folder / "mixed.npz", t=np.arange(4.0), x=np.ones((4, 3, 2)), y=np.array("a"), z=np.zeros((0, 3)))
    np.save(folder / "dates.npy", np.arange(12).reshape(3, 4).astype("datetime64[s]"))
    np.save(folder / "five.npy", np.zeros((2, 2, 2, 3, 4)))
    np.save(folder / "none.npy", np.zeros((0, 4)))
