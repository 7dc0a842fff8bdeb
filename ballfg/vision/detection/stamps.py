"""Stamps of frames from a CSV file."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ballfg.tracks.checks import check_step

Array = NDArray[np.float64]


def read_stamps(path: Path) -> Array:
    """(f,) s, strictly increasing, one a frame.

    Args: path: a CSV file with a header; column `t` (s), optionally `frame`, which then counts from 0.
    Raises: FileNotFoundError: no such file. ValueError: no column `t`, no rows, or a row that breaks a rule.
    """
    if not path.is_file():
        raise FileNotFoundError(f"file of stamps {path} does not exist. Check the path.")
    stamps: list[float] = []
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        names = rows.fieldnames or []
        if "t" not in names:
            raise ValueError(
                f"{path} must have a column t (s); got {', '.join(names) or 'no header'}. Name it in line 1."
            )
        for row in rows:
            where = f"{path}, line {rows.line_num}"
            if "frame" in names and row["frame"] != str(len(stamps)):
                raise ValueError(
                    f"{where}: frame must count from 0; got {row['frame']!r} for {len(stamps)}. Sort the rows."
                )
            stamps.append(_number(where, row["t"]))
            if len(stamps) > 1 and not stamps[-1] > stamps[-2]:
                raise ValueError(
                    f"{where}: t must increase; frame {len(stamps) - 1} has {stamps[-1]!r} s after {stamps[-2]!r} s. "
                    "Sort the rows or correct the stamps."
                )
    if not stamps:
        raise ValueError(f"{path} must have one row a frame; got none.")
    check_step(str(path), np.array(stamps))
    return np.array(stamps)


def _number(where: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"{where}: t must be a finite number of seconds; got {text!r}. Correct it.")
    return value
