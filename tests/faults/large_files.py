"""Large files that are good, and must be read: captures of half an hour, tracks of a million samples, large images."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ballfg.importing.formats.sources import tables_of
from ballfg.tracks import read_dataset
from ballfg.vision.calibration.boards import read_grey
from tests.faults.seeds import INFO

Write = Callable[[Path], object]
SAMPLES = 1_000_000
CAPTURE = 450_000
"""Samples of a capture: 30 MB of JSON."""


def _columns(samples: int) -> dict[str, np.ndarray]:
    """A ball that rolls to and fro at 100 Hz, with the noise of a tracker."""
    rng, t = np.random.default_rng(3), np.arange(samples) / 100.0
    return {"t": t, **{axis: np.sin(t + k) + rng.normal(0.0, 0.003, samples) for k, axis in enumerate("xyz")}}


def _json(path: Path) -> None:
    """A list of rows, as captures write them."""
    rows = zip(*(column.round(6).tolist() for column in _columns(CAPTURE).values()), strict=True)
    path.write_text(json.dumps([dict(zip("txyz", row, strict=True)) for row in rows]))


def _nested_json(path: Path) -> None:
    """Shots with their samples."""
    rows = np.column_stack(list(_columns(CAPTURE).values())).round(6).tolist()
    shots = [rows[start : start + 300] for start in range(0, CAPTURE, 300)]
    path.write_text(
        json.dumps([{"shot": k, "samples": [{"t": t, "p": p} for t, *p in shot]} for k, shot in enumerate(shots)])
    )


def _dataset(ending: str) -> Write:
    def write(path: Path) -> None:
        path.mkdir()
        (path / "dataset.yaml").write_text(INFO)
        table = pa.table({"trajectory": np.repeat("rally", SAMPLES), **_columns(SAMPLES)})
        if ending == "parquet":
            pq.write_table(table, path / "tracks.parquet")
        else:
            pa.csv.write_csv(table, path / "tracks.csv")

    return write


def _csv(path: Path) -> None:
    np.savetxt(path, np.column_stack(list(_columns(CAPTURE).values())), "%.6f", ",", header="t,x,y,z", comments="")


def _npz(path: Path) -> None:
    np.savez_compressed(path, **_columns(SAMPLES))


def _image(width: int, height: int) -> Write:
    noise = np.random.default_rng(1)
    return lambda path: cv2.imwrite(str(path), noise.integers(0, 255, (height, width), dtype=np.uint8))


LARGE: dict[str, tuple[str, Write, Callable[[Path], object]]] = {
    "tracks.csv, a million samples": ("d", _dataset("csv"), lambda path: list(read_dataset(path))),
    "tracks.parquet, a million samples": ("d", _dataset("parquet"), lambda path: list(read_dataset(path))),
    "JSON, rows, 30 MB": ("x.json", _json, tables_of),
    "JSON, shots, 30 MB": ("x.json", _nested_json, tables_of),
    "CSV to import, 450,000 rows": ("x.csv", _csv, tables_of),
    "npz, a million samples": ("x.npz", _npz, tables_of),
    "an image in 4K": ("x.png", _image(3840, 2160), read_grey),
    "an image of 60 million pixels": ("x.jpg", _image(10_000, 6000), read_grey),
}
"""By name: the file or folder, what writes it, and what reads it."""
