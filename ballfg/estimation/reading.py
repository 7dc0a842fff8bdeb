"""Opens a folder for estimation: its tracks or sightings, with all other readings beside them."""

from os import PathLike
from pathlib import Path

from ballfg.checks import check_path
from ballfg.dynamics.compiled.kept_model import content_of
from ballfg.dynamics.nominal import ready_nominal
from ballfg.estimation.observations.registry import read_readings
from ballfg.estimation.observations.sighted_dataset import SightedDataset, read_sighted
from ballfg.files.strict_yaml import read_mapping
from ballfg.files.whole_folder import of_one_state
from ballfg.tracks import Ball, Dataset, read_dataset
from ballfg.tracks.dataset import has_positions as has_positions

MODEL_FILE = "model.yaml"


@of_one_state
def read(folder: str | PathLike[str]) -> Dataset | SightedDataset:
    """The dataset of a folder: its tracks with all further measurements.

    In a folder with detections and cameras but no table of tracks, the tracks are made from the detections.

    Args: folder: holds `dataset.yaml` and tables; docs/tracks.md.
    Returns: the dataset; its `notes` list ignored, repaired and unused files and rows.
    Raises:
        FileNotFoundError: the folder or one of its files is missing.
        ValueError: the content breaks a rule; the message names file, line, column and remedy.
    """
    folder = check_path("folder", folder)
    dataset = with_readings(read_dataset(folder)) if has_positions(folder) else read_sighted(folder)
    dataset.notes = [*dataset.notes, *unused_model(folder, dataset.ball)]
    return dataset


def with_readings(dataset: Dataset) -> Dataset:
    """The dataset, its tracks extended by the readings in its folder."""
    readings = read_readings(dataset.path, dataset.names)
    return dataset.with_readings(readings.attached, readings.notes) if readings.rows else dataset


def unused_model(folder: str | PathLike[str], ball: Ball) -> tuple[str, ...]:
    """A note on a model file beside the tracks that differs from the ball's nominal model, if any."""
    path = Path(folder) / MODEL_FILE
    if not path.is_file():
        return ()
    try:
        if read_mapping(path) == content_of(ready_nominal(ball)):
            return ()
    except ValueError:
        pass  # an unreadable file counts as another model; reading it raises where a user gives it as the model
    return (f"{path} lies beside the tracks and is not used. Give it as the model to use it.",)
