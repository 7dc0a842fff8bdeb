"""Stamps of frames from a CSV file."""

from pathlib import Path

import numpy as np

from ballfg.tracks import csv_files
from ballfg.tracks.checks import check_step
from ballfg.vision.arrays import Array


def read_stamps(path: Path) -> Array:
    """(f,) s, strictly increasing, one a frame.

    Args: path: a CSV file with a header; column `t` (s), optionally `frame`, which then counts from 0.
    Raises: FileNotFoundError: no such file. ValueError: no column `t`, no rows, or a row that breaks a rule.
    """
    if not path.is_file():
        raise FileNotFoundError(f"file of stamps {path} does not exist. Check the path.")
    names = [name.strip() for name in csv_files.read_header(path)]
    if "t" not in names:
        raise ValueError(f"{path} must have a column t (s); got {', '.join(names)}. Name it in line 1.")
    stamps: list[float] = []
    for line, cells in csv_files.records(path):
        where = f"{path}, line {line}"
        row = dict(zip(names, (cell.strip() for cell in cells), strict=False))
        if "frame" in names and row.get("frame") != str(len(stamps)):
            raise ValueError(
                f"{where}: frame must count from 0; got {row.get('frame')!r} for {len(stamps)}. Sort the rows."
            )
        if not csv_files.is_number(row.get("t", "")):
            raise ValueError(f"{where}: t must be a finite number of seconds; got {row.get('t')!r}. Correct it.")
        stamps.append(float(row["t"]))
        if len(stamps) > 1 and not stamps[-1] > stamps[-2]:
            raise ValueError(
                f"{where}: t must increase; frame {len(stamps) - 1} has {stamps[-1]!r} s after {stamps[-2]!r} s. "
                "Sort the rows or correct the stamps."
            )
    if not stamps:
        raise ValueError(f"{path} must have one row a frame; got none.")
    check_step(str(path), np.array(stamps))
    return np.array(stamps)
