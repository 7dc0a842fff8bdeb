"""A folder opened for estimation: its tracks, or what cameras saw, with all other readings that lie beside them."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from ballfg.estimation.observations.files import read_readings
from ballfg.estimation.observations.sighted_dataset import SightedDataset, read_sighted
from ballfg.tracks import Dataset, read_dataset
from ballfg.tracks.dataset import TRACK_FILES
from ballfg.tracks.detections_file import DETECTIONS_FILE

MODEL_FILE = "model.yaml"


def has_positions(folder: str | PathLike[str]) -> bool:
    """Whether a folder holds a table of tracks, or no detections either."""
    path = Path(folder)
    return any((path / name).is_file() for name in TRACK_FILES) or not (path / DETECTIONS_FILE).is_file()


def read(folder: str | PathLike[str]) -> Dataset | SightedDataset:
    """The dataset of a folder: its tracks with everything that was measured beside positions.

    Where the folder has no table of tracks, but detections and cameras, the tracks are those that the cameras saw.

    Args: folder: holds `dataset.yaml` and tables; docs/tracks.md.
    Returns: the dataset; its `notes` tell what was ignored, repaired, or lies unused beside the tracks.
    Raises:
        FileNotFoundError: the folder or one of its files is missing.
        ValueError: the content breaks a rule; the message names file, line, column and remedy.
    """
    if not has_positions(folder):
        return read_sighted(folder)
    return with_readings(read_dataset(folder))


def with_readings(dataset: Dataset) -> Dataset:
    """The dataset whose tracks come with the readings that lie in its folder."""
    readings = read_readings(dataset.path, dataset.names)
    notes = list(readings.notes)
    if (dataset.path / MODEL_FILE).is_file():
        notes.append(
            f"{dataset.path / MODEL_FILE} lies beside the tracks and is not used. Name it as the model to use it."
        )
    return dataset.with_readings(readings.attached, notes) if readings.rows or notes else dataset
