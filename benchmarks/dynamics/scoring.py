"""Scores predicted paths over the track, over its unobserved part, and at the apex of each flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.benchmarks.dynamics.task import TaskShot
from ballfg.benchmarks.metrics import square_norms
from ballfg.prediction.apexes import FLIGHTS, flight_bounds, path_apex


@dataclass(frozen=True)
class PathScore:
    """The errors of one predicted path.

    Attributes:
        track: m^2, of the squared distances over all judged samples (None if some were not predicted); their number.
        rest: the same over the judged samples after the observed ones.
        apex: m, distance between predicted and reference apex by flight (`APEXES`); None where either is missing.
        apex_ahead: True if the reference apex lies after the observed part.
    """

    track: tuple[float | None, int]
    rest: tuple[float | None, int]
    apex: tuple[float | None, float | None, float | None]
    apex_ahead: tuple[bool, bool, bool]

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
    Raises: ValueError: if the shape is another, or an unobserved position is not finite.
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
