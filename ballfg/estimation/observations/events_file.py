"""Reads the bounces in `events.csv`, as `ballfg track` writes it of one moving camera."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.tracks import csv_files
from ballfg.tracks.rows import KEY

EVENTS_FILE: Final = "events.csv"
NEEDED: Final = (KEY, "t", "kind")


def read_bounces(path: Path) -> dict[str, Array]:
    """The stamps (b,) s of the bounces of each trajectory that the file names, ascending.

    Args: path: a table with the columns `trajectory`, `t` (s) and `kind`.
    Raises: ValueError: a column that is missing, a stamp that is no number; the message names the file and the line.
    """
    names = [name.strip() for name in csv_files.read_header(path)]
    if missing := [name for name in NEEDED if name not in names]:
        raise ValueError(f"{path} must have the columns {', '.join(NEEDED)}; {missing[0]} is missing. Track again.")
    found = dict[str, list[float]]()
    for line, cells in csv_files.records(path):
        row = dict(zip(names, (cell.strip() for cell in cells), strict=False))
        if not csv_files.is_number(row.get("t", "")):
            raise ValueError(f"{path}, line {line}: t must be a number; got {row.get('t')!r}. Track again.")
        mine = found.setdefault(row[KEY], [])
        if row.get("kind") == "bounce":
            mine.append(float(row["t"]))
    return {name: np.sort(np.array(times, dtype=np.float64)) for name, times in found.items()}
