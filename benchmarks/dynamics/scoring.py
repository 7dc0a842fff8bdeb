"""Errors of predicted paths: over the track, over its unobserved part, and of the apex of each flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.benchmarks.dynamics.task import Shot
from ballfg.benchmarks.metrics import square_norms
from ballfg.prediction.apexes import FLIGHTS, flight_bounds, path_apex


@dataclass(frozen=True)
class PathScore:
    """The errors of one predicted path.

    Attributes:
        track_sum: m^2, of the squared distances over all judged samples; NaN if some were not predicted.
        track_points: number of these samples.
        rest_sum, rest_points: the same over the judged samples after the observed ones.
        apex: (3,) m, distance between predicted and reference apex by flight (`APEXES`); NaN where either is missing.
        apex_ahead: (3,) whether the reference apex lies after the observed part.
    """

    track_sum: float
    track_points: int
    rest_sum: float
    rest_points: int
    apex: Array
    apex_ahead: NDArray[np.bool_]

    @property
    def track_rmse(self) -> float:
        """m, root mean square distance over the judged samples."""
        return float(np.sqrt(self.track_sum / self.track_points))

    @property
    def rest_rmse(self) -> float:
        """m, the same after the observed part; NaN where nothing is left to predict."""
        return float(np.sqrt(self.rest_sum / self.rest_points)) if self.rest_points else float("nan")

    def to_json(self) -> dict[str, Any]:
        """Plain numbers; null where there is none."""
        numbers = [self.track_sum, self.rest_sum, *self.apex]
        track, rest, *apex = (float(number) if np.isfinite(number) else None for number in numbers)
        return {
            "track": [track, self.track_points],
            "rest": [rest, self.rest_points],
            "apex": apex,
            "apex_ahead": self.apex_ahead.tolist(),
        }

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> PathScore:
        """The score that `to_json` wrote."""
        (track, track_points), (rest, rest_points) = content["track"], content["rest"]
        numbers = np.array([track, rest, *content["apex"]], dtype=np.float64)  # None becomes NaN
        ahead = np.array(content["apex_ahead"], dtype=bool)
        return cls(float(numbers[0]), int(track_points), float(numbers[1]), int(rest_points), numbers[2:], ahead)


def score_path(shot: Shot, predicted: Array) -> PathScore:
    """The errors of a path predicted for a shot.

    Args:
        shot: what it is judged by.
        predicted: (n, 3) m at the shot's stamps; NaN at observed stamps by methods that predict only what comes after.
    Raises: ValueError: if the shape is another, or an unobserved position is not finite.
    """
    if predicted.shape != shot.reference.shape:
        raise ValueError(f"predicted must have shape {shot.reference.shape}; got {predicted.shape}.")
    if not np.isfinite(predicted[shot.observed :]).all():
        raise ValueError(f"predicted must be finite after the {shot.observed} observed samples; it is not.")
    squares = square_norms(predicted - shot.reference)[: shot.judged]
    rest = squares[shot.observed :]
    times = shot.track.times
    return PathScore(
        track_sum=float(squares.sum()),
        track_points=len(squares),
        rest_sum=float(rest.sum()),
        rest_points=len(rest),
        apex=apex_errors(times, predicted, shot.bounces, shot.apexes, shot.apex_times),
        apex_ahead=shot.apex_times > times[shot.observed - 1],
    )


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


def pooled_rmse(sums: Sequence[float], points: Sequence[int]) -> float:
    """m: root mean square distance over all samples of all tracks."""
    return float(np.sqrt(sum(sums) / sum(points)))
