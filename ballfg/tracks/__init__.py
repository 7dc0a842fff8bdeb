"""Tracks and datasets: reading, checking and writing them; docs/tracks.md describes the files."""

from .dataset import Dataset, read_dataset
from .detections_file import read_sightings, write_sightings
from .info import TABLE_TENNIS, TENNIS, Ball, DatasetInfo
from .sightings import Sightings
from .table import TableWriter
from .track import SPIN_LABELS, Label, Track
from .writing import write_dataset

__all__ = [
    "SPIN_LABELS",
    "TABLE_TENNIS",
    "TENNIS",
    "Ball",
    "Dataset",
    "DatasetInfo",
    "Label",
    "Sightings",
    "TableWriter",
    "Track",
    "read_dataset",
    "read_sightings",
    "write_dataset",
    "write_sightings",
]
