"""Tracks and datasets: reading, checking and writing them; docs/tracks.md describes the files."""

from ballfg.tracks.dataset import Dataset, read_dataset
from ballfg.tracks.detections_file import read_sightings, write_sightings
from ballfg.tracks.info import TABLE_TENNIS, TENNIS, Ball, DatasetInfo
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.table import TableWriter
from ballfg.tracks.track import SPIN_LABELS, Label, Track
from ballfg.tracks.writing import write_dataset

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
