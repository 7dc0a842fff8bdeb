"""Writes sightings and readings as the tables that a dataset has of them."""

import os
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ballfg.arrays import Array
from ballfg.tracks import TableWriter, Track
from ballfg.tracks.detections_file import RADIUS, seen_columns
from ballfg.tracks.rows import KEY
from ballfg.tracks.sightings import Sightings


def write_sightings(path: str | os.PathLike[str], balls: Iterable[tuple[str, Sightings]]) -> None:
    """Writes a `detections.csv` with the trajectory of each row; pixels and stamps read back bit for bit.

    Args: path: ends in .csv.  balls: name of the trajectory and sightings of each.
    Raises: ValueError: no balls, or another ending. FileNotFoundError: the folder does not exist.
    """
    with TableWriter(path) as table:
        for name, seen in balls:
            camera = np.array(seen.cameras, dtype=object)[seen.camera]
            radii = {} if seen.radii is None else dict(zip(RADIUS, seen.radii.T, strict=True))
            table.write({KEY: name} | seen_columns(seen.times, camera, seen.pixels, seen.covariances) | radii)


def write_readings(folder: str | os.PathLike[str], tracks: Iterable[Track]) -> list[Path]:
    """Writes the readings of tracks as tables into the folder of their dataset.

    Args: folder: it exists.  tracks: with their observations.
    Returns: the files; empty if no track has readings.
    """
    tables: defaultdict[str, list[tuple[str, dict[str, Array]]]] = defaultdict(list)
    for track in tracks:
        for observation in track.observations:
            if observation.file is not None:
                tables[observation.file].append((track.name, dict(observation.table(track))))
    for name, parts in tables.items():
        with TableWriter(Path(folder) / name) as writer:
            for trajectory, columns in parts:
                writer.write({KEY: trajectory, **columns})
    return [Path(folder) / name for name in tables]
