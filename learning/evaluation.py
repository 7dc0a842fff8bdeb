"""Measures a model's prediction errors on other tracks: it observes the first part and predicts the rest.

Errors of tracks that cameras saw are those across the rays of their sightings; nobody measured the others.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ballfg.arrays import Array
from ballfg.estimation import Estimator, Status, predict_tracks
from ballfg.estimation.noise.forecasts import NINETY
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.tracks import Track

OUTLIERS: Final = 0.01  # Share of coordinates that a prediction may miss, as after a hit that nobody foresees
WIDER: Final = 10.0  # Width of their density, in standard deviations: one missed bounce does not decide a comparison

JUDGED: Final = (Status.OK, Status.DEPTH_UNCERTAIN)  # Statuses of estimates whose predictions count


class Plain(BaseModel):
    """Plain numbers and texts, for files: strict types, no unknown keys, immutable, finite."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


class TrackScore(Plain):
    """Prediction errors of one track, within bounds that only numbers from a damaged checkpoint pass."""

    name: str
    samples: int = Field(ge=1)  # Number of predicted samples
    rmse: float = Field(ge=0.0, le=1e9)  # m, root of the mean squared distance between predicted and measured positions
    covered: float = Field(ge=0.0, le=1.0)  # Share of measured coordinates inside the central 90 % intervals
    prediction_nis: float = Field(ge=0.0, le=1e100)
    """Mean over the predicted samples of the squared errors in standard deviations, x, y and z added; 3 is right. Those
    of sightings are scaled from two coordinates to three."""
    log_score: float = Field(ge=-1e9, le=1e9)
    """Mean over measured coordinates of the log density that the prediction gives them, per metre; higher is better."""
    nis: float = Field(ge=0.0, le=1e100)
    """Mean NIS of the observed samples, each against its prediction from the others; 3 is right."""


class Summary(Plain):
    """Prediction errors of a set of tracks."""

    tracks: int
    rmse_median: float  # m, median over tracks
    rmse_pooled: float  # m, root mean square over all predicted samples, which the worst tracks dominate
    coverage_90: float  # Share of measured coordinates inside the central 90 % intervals
    prediction_nis: float  # Mean over predicted samples; 3 is right
    nis: float  # Mean over tracks of the observed part's NIS; 3 is right


def judge_track(estimator: Estimator, track: Track, observed_share: float, horizon: float) -> TrackScore | None:
    """The score of one track; None if it has nothing to predict, or the estimate failed.

    Args:
        observed_share: share of the duration that is observed, above 0 and below 1.
        horizon: s that are predicted, `inf` for the whole rest.
    """
    if len(track) < 2:
        return None
    prediction = next(predict_tracks(estimator, [track], 1, observed_share * track.duration, horizon=horizon))
    nis = prediction.estimate.nis[np.isfinite(prediction.estimate.nis)]
    if prediction.status not in JUDGED or not len(prediction.times) or not len(nis):
        return None
    error, sigmas = _errors(track, prediction)
    whitened = error / sigmas
    if not len(error) or not np.isfinite(whitened).all():
        return None
    three = 3.0 / error.shape[1]
    return TrackScore(
        name=track.name,
        samples=len(error),
        rmse=float(np.sqrt((error**2).sum(axis=-1).mean())),
        covered=float((np.abs(whitened) <= NINETY).mean()),
        prediction_nis=three * float((whitened**2).sum(axis=-1).mean()),
        log_score=float(log_density(whitened, sigmas).mean()),
        nis=three * float(nis.mean()),
    )


def _errors(track: Track, prediction: TrackPrediction) -> tuple[Array, Array]:
    """(k, 3) m errors of positions, or (m, 2) m across the rays of sightings, and their standard deviations."""
    if not track.rough:
        return prediction.positions - prediction.measured, prediction.sigmas
    assert prediction.covariances is not None
    return sightings_of(track).across(len(prediction.estimate), prediction.positions, prediction.covariances)


def log_density(whitened: Array, sigmas: Array) -> Array:
    """Log density, per metre, of errors under a Gaussian, of which a small share is wider.

    Args: whitened: (...) errors in standard deviations.  sigmas: (...) m.
    """
    plain = np.log1p(-OUTLIERS) - 0.5 * whitened**2
    wide = np.log(OUTLIERS / WIDER) - 0.5 * (whitened / WIDER) ** 2
    return np.asarray(np.logaddexp(plain, wide) - np.log(sigmas) - 0.5 * np.log(2.0 * np.pi))


def summary(scores: Sequence[TrackScore]) -> Summary | None:
    """The summary of some scores; None for no tracks."""
    if not scores:
        return None
    samples, rmse, covered, prediction_nis, nis = np.array(
        [(s.samples, s.rmse, s.covered, s.prediction_nis, s.nis) for s in scores], dtype=np.float64
    ).T.copy()
    share = samples / samples.sum()
    return Summary(
        tracks=len(scores),
        rmse_median=float(np.median(rmse)),
        rmse_pooled=float(np.sqrt(share @ rmse**2)),
        coverage_90=float(share @ covered),
        prediction_nis=float(share @ prediction_nis),
        nis=float(np.mean(nis)),
    )
