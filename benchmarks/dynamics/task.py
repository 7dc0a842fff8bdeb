"""Holds the tracks of the dynamics comparison: shots for training and for judging, and common settings."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from ballfg.arrays import Array
from ballfg.dynamics import BallModel, Surfaces
from ballfg.estimation import Settings
from ballfg.estimation.launcher import Launcher
from ballfg.tracks import Track, write_dataset
from ballfg.tracks.info import DatasetInfo

APEXES: Final = ("before_1", "1_2", "2_3")
"""The flights whose highest point is judged: before the first bounce, between the first two, between the next two."""
VALIDATE_ONE_IN: Final = 10
SPLIT_LABEL: Final = "split"  # The label in a written task that says which part a track belongs to


@dataclass(frozen=True)
class TaskShot:
    """One track with its reference.

    Attributes:
        track: stamps, measured positions and labels: all that a model may see.
        reference: (n, 3) m, the positions that count: the true ones where there is truth, else the measured ones.
        observed: number of first samples that a model is given.
        judged: number of first samples for the errors; the rest of the track serves for apexes only.
        bounces: (b,) s, on the track's clock, in order.
        apexes: (3, 3) m, the highest points of the flights in `APEXES`; NaN where a flight has none inside the track.
        apex_times: (3,) s; NaN likewise.  states: (n, 9) the true states; None for measured tracks.
    """

    track: Track
    reference: Array
    observed: int
    judged: int
    bounces: Array
    apexes: Array
    apex_times: Array
    states: Array | None = None

    @property
    def seen(self) -> Track:
        """The observed samples."""
        return self.track.until(float(self.track.times[self.observed - 1]))


@dataclass(frozen=True)
class Task:
    """A comparison.

    Attributes:
        case: its name in `results.json`.  info: the declared table, ball, rate and position noise.
        surfaces: table and floor, for every model.
        settings: of the estimator, the same for every model but for noise that a model has learned.
        launcher: spin per level for models that do not learn it; None where the tracks have no levels.
        launcher_labels: labels from which trained models learn the spin.
        observe: the observed part of a shot, as in a training config.
        truth: the true dynamics; None for measured tracks.  train: shots to learn from.  validation: shots to judge by.
    """

    case: str
    info: DatasetInfo
    surfaces: Surfaces
    settings: Settings
    launcher: Launcher | None
    launcher_labels: tuple[str, ...]
    observe: Mapping[str, float]
    truth: BallModel | None
    train: tuple[TaskShot, ...]
    validation: tuple[TaskShot, ...]

    def write(self, folder: Path, *, validate: bool = True) -> None:
        """Write the tracks of both parts into a new folder, as a dataset with a label `split`.

        The shots to judge by are tests, which no training looks at. With `validate`, one in ten of the others decides
        which weights are kept; without it all of them train, and the last weights are kept.

        Raises: FileNotFoundError: if the folder's parent does not exist.
        """
        last = VALIDATE_ONE_IN - 1
        parts = ["validation" if validate and k % VALIDATE_ONE_IN == last else "train" for k in range(len(self.train))]
        labelled = [*zip(self.train, parts, strict=True), *((shot, "test") for shot in self.validation)]
        tracks = [replace(s.track, labels={**s.track.labels, SPLIT_LABEL: part}) for s, part in labelled]
        write_dataset(folder, self.info, sorted(tracks, key=lambda track: track.name), "parquet")
