"""Holds the tracks of the dynamics comparison, shots for training and for judging, and scores predicted paths."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.benchmarks.metrics import square_norms
from ballfg.dynamics import BallModel, Surfaces
from ballfg.estimation import Settings
from ballfg.estimation.launcher import Launcher
from ballfg.prediction.apexes import FLIGHTS, flight_bounds, path_apex
from ballfg.tracks import Track, write_dataset
from ballfg.tracks.info import DatasetInfo

APEXES: Final = ("before_1", "1_2", "2_3")
"""The flights whose highest point is judged: before the first bounce, between the first two, between the next two."""
VALIDATE_ONE_IN: Final = 10
SPLIT_LABEL: Final = "split"  # The label in a written task that says which part a track belongs to


@dataclass(frozen=True)
class TaskShot:
    """One track with its reference."""

    track: Track  # stamps, measured positions and labels: all that a model may see
    reference: Array  # (n, 3) m, the positions that count: the true ones where there is truth, else the measured ones
    observed: int  # number of first samples that a model is given
    judged: int  # number of first samples for the errors; the rest of the track serves for apexes only
    bounces: Array  # (b,) s, on the track's clock, in order
    apexes: Array
    """(3, 3) m, the highest points of the flights in `APEXES`; NaN where a flight has none inside the track."""
    apex_times: Array  # (3,) s; NaN likewise
    states: Array | None = None  # (n, 9) the true states; None for measured tracks

    @property
    def seen(self) -> Track:
        """The observed samples."""
        return self.track.until(float(self.track.times[self.observed - 1]))


@dataclass(frozen=True)
class Task:
    """A comparison."""

    case: str  # its name in `results.json`
    info: DatasetInfo  # the declared table, ball, rate and position noise
    surfaces: Surfaces  # table and floor, for every model
    settings: Settings  # of the estimator, the same for every model but for noise that a model has learned
    launcher: Launcher | None  # spin per level for models that do not learn it; None where the tracks have no levels
    launcher_labels: tuple[str, ...]  # labels from which trained models learn the spin
    observe: Mapping[str, float]  # the observed part of a shot, as in a training config
    truth: BallModel | None  # the true dynamics; None for measured tracks
    train: tuple[TaskShot, ...]  # shots to learn from
    validation: tuple[TaskShot, ...]  # shots to judge by

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


@dataclass(frozen=True)
class PathScore:
    """The errors of one predicted path."""

    track: tuple[float | None, int]
    """m^2, of the squared distances over all judged samples (None if some were not predicted); their number."""
    rest: tuple[float | None, int]  # the same over the judged samples after the observed ones
    apex: tuple[float | None, float | None, float | None]
    """m, distance between predicted and reference apex by flight (`APEXES`); None where either is missing."""
    apex_ahead: tuple[bool, bool, bool]  # True if the reference apex lies after the observed part

    @property
    def track_rmse(self) -> float:
        """m, root mean square distance over the judged samples; NaN if some were not predicted."""
        return pooled_rmse([self.track])

    @property
    def rest_rmse(self) -> float:
        """m, the same after the observed part; NaN where nothing is left to predict."""
        return pooled_rmse([self.rest])


def score_path(shot: TaskShot, predicted: Array) -> PathScore:
    """The errors of a path predicted for a shot.

    Args:
        predicted: (n, 3) m at the shot's stamps; NaN at observed stamps by methods that predict only what comes after.
    """
    if predicted.shape != shot.reference.shape:
        raise ValueError(f"predicted must have shape {shot.reference.shape}; got {predicted.shape}.")
    if not np.isfinite(predicted[shot.observed :]).all():
        raise ValueError(f"predicted must be finite after the {shot.observed} observed samples; it is not.")
    squares = square_norms(predicted - shot.reference)[: shot.judged]
    rest = squares[shot.observed :]
    times = shot.track.times
    errors = apex_errors(times, predicted, shot.bounces, shot.apexes, shot.apex_times)
    first, second, third = (float(error) if np.isfinite(error) else None for error in errors)
    whole = float(squares.sum()) if np.isfinite(squares).all() else None
    a, b, c = (shot.apex_times > times[shot.observed - 1]).tolist()
    return PathScore((whole, len(squares)), (float(rest.sum()), len(rest)), (first, second, third), (a, b, c))


def apex_errors(times: Array, predicted: Array, bounces: Array, apexes: Array, apex_times: Array) -> Array:
    """Distance between predicted and reference apex of each flight.

    The flights are those of the reference: a prediction that bounces early or late is searched for its highest point
    between the reference's bounces.

    Args:
        times: (n,) s.  predicted: (n, 3) m, NaN where nothing was predicted.
        bounces: (b,) s.  apexes: (3, 3) m.  apex_times: (3,) s; NaN where a flight has none.
    Returns: (3,) m; NaN where the reference has no apex or the path was not predicted at it.
    """
    errors = np.full(FLIGHTS, np.nan)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(predicted).all(axis=-1))
    for flight, (start, end) in enumerate(flight_bounds(times, bounces)):
        at = apex_times[flight]
        if np.isfinite(at) and known[np.abs(times - at).argmin()]:
            point, _ = path_apex(times[known], predicted[known], start, end)
            errors[flight] = float(np.linalg.norm(point - apexes[flight]))
    return errors


def pooled_rmse(parts: Sequence[tuple[float | None, int]]) -> float:
    """m: root mean square distance over all samples of sums of squares with their numbers; NaN where one is unknown."""
    number = sum(points for _, points in parts)
    return float(np.sqrt(sum(np.nan if total is None else total for total, _ in parts) / number)) if number else np.nan
