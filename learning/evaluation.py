"""Measures a model's prediction errors on other tracks, whose first part it observes, and decides which is better.

Errors of tracks that cameras saw are those across the rays of their sightings; nobody measured the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy import stats

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


SURE: Final = 0.95  # Probability of the interval
LEAST: Final = 0.02
"""Smallest change, as a share of the errors, that counts: fitted coefficients cost about as much where nothing is
gained."""
DENSER: Final = 0.1
"""Smallest rise of the logarithm of a coordinate's density that counts where errors do not decide: a population that is
known narrows intervals by 0.01 to 0.06 where nothing is gained (16 simulated sets, seeds 600 to 615)."""
SMALLEST: Final = 1e-9  # m, of an error


@dataclass(frozen=True)
class Gain:
    """The change of the errors from one model to another on the same tracks, as a share; negative is better.

    Attributes:
        mean: geometric mean over tracks, minus one.  low, high: the ends of its 95 % interval.  tracks: their number.
        density: mean and lower end of the rise of the logarithm of a measured coordinate's density, both models with
            the noise that the fitted tracks show; None if unknown.
    """

    mean: float
    low: float
    high: float
    tracks: int
    density: tuple[float, float] | None = None

    @property
    def word(self) -> str:
        """Better, worse, or no different: by the interval of the errors, then by that of the density."""
        if self.high < 0.0 and self.mean < -LEAST:
            return "better"
        if self.density is not None and self.density[1] > DENSER and self.low <= 0.0:
            return "better"
        return "worse" if self.low > 0.0 and self.mean > LEAST else "no different"

    def __str__(self) -> str:
        said = (
            f"errors change by {100 * self.mean:+z.0f} % ({100 * self.low:+z.0f} to {100 * self.high:+z.0f} %, 95 % "
            f"interval over {self.tracks} tracks that were not fitted)"
        )
        if self.density is None:
            return said
        mean, low = np.exp(self.density)
        return f"{said}; what was measured is {mean:.2f} times as probable (surely {low:.2f} times)"


def denser(before: Array, after: Array) -> tuple[float, float]:
    """Mean rise of log scores (n,) of the same tracks, n > 1, and the lower end of its 95 % interval."""
    mean, reach = _interval(after - before)
    return mean, mean - reach


def gain_of(before: Array, after: Array) -> Gain | None:
    """The change of errors; None with fewer than two tracks.

    The logarithms of the ratios have Student's distribution about their mean.

    Args: before, after: (n,) m, RMSE of the same tracks.
    """
    count = len(before)
    if count < 2:
        return None
    mean, reach = _interval(np.log(np.maximum(after, SMALLEST)) - np.log(np.maximum(before, SMALLEST)))
    middle, low, high = (float(np.expm1(end)) for end in (mean, mean - reach, mean + reach))
    return Gain(middle, low, high, count)


def _interval(values: Array) -> tuple[float, float]:
    """The mean of values (n,), and half the length of its 95 % interval by Student's distribution."""
    count = len(values)
    reach = stats.t.ppf(0.5 + SURE / 2.0, count - 1) * values.std(ddof=1) / np.sqrt(count)
    return float(values.mean()), float(reach)
