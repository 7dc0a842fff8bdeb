"""Records a filter's run over a track and smooths it by the Rauch-Tung-Striebel pass.

Source: H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal
3(8), 1965, equations 3.30 and 3.31; the covariance in the form that stays positive definite under rounding.
"""

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.arrays import fly_jacobian
from ballfg.estimation.observations.innovation import leave_position_out
from ballfg.estimation.segmentation.result import Contact, Quality
from ballfg.factors.batch import Rows
from ballfg.factors.linear.definite import raised
from ballfg.factors.loss import Loss
from ballfg.state import STATE_DIM


class FilterRecord:
    """A filter's belief at each of n samples, in d numbers: state, coefficients of the model, tracker's bias.

    Attributes:
        start: first sample with a belief.  prior_mean: (n, d) and prior_covariance: (n, d, d), before the sample.
        mean: (n, d) and covariance: (n, d, d), after it.
        transition: (n, d, d), Jacobian of the motion from the sample before.
        noise: (n, d, d), process noise gathered since the sample before.
        measurement_noise: (n, 3, 3) m^2, covariance of the sample's white error and of that of its stamp.
        whitened: (n, 3), innovations divided by their standard deviations; NaN where a sample has none.
        quality: (n,) `Quality`.  least: (d,) least standard deviations, against rounding.
        contacts: for each interval with any.  hits: intervals.
    """

    def __init__(self, n: int, d: int) -> None:
        self.prior_mean, self.mean, self.least = np.zeros((n, d)), np.zeros((n, d)), np.zeros(d)
        self.prior_covariance, self.covariance = np.zeros((n, d, d)), np.zeros((n, d, d))
        self.transition, self.noise = np.zeros((n, d, d)), np.zeros((n, d, d))
        self.measurement_noise, self.whitened = np.zeros((n, 3, 3)), np.full((n, 3), np.nan)
        self.quality = np.full(n, Quality.GOOD, dtype=np.int8)
        self.start = 0
        self.contacts: dict[int, tuple[Contact, ...]] = {}
        self.hits: list[int] = []

    @property
    def used(self) -> NDArray[np.bool_]:
        """(n,) the samples that the filter used."""
        return self.quality != Quality.OUTLIER

    def innovations(self, H: Array, mean: Array, covariance: Array, measured: Array) -> Array:
        """(n, 3) whitened: each sample measured (n, 3) m against its prediction from all others.

        Args: H: (3, d) of a measured position.  mean, covariance: (n, d) and (n, d, d), given all samples.
        """
        n, expected = len(mean), mean @ H.T
        used = self.used & (np.arange(n) >= self.start)
        root = np.linalg.inv(np.linalg.cholesky(self.measurement_noise))
        whitening = np.where(used[:, None, None], root, 0.0)
        residual = (whitening @ (expected - measured)[..., None])[..., 0]
        samples = Rows(np.arange(n)[:, None], residual, (whitening,), Loss())
        return leave_position_out(expected, H @ covariance @ H.T, measured, self.measurement_noise, samples)


def rts_smooth(record: FilterRecord) -> tuple[Array, Array]:
    """Means (n, d) and covariances (n, d, d) given all samples; entries before `record.start` stay.

    Filterpy has this pass for linear filters only: it predicts with F x; here the prediction is the motion itself.

    With C = P_k F^T (P-_{k+1})^-1, from the last sample to the first:
    x^s_k = x_k + C (x^s_{k+1} - x-_{k+1}) and P^s_k = (I - C F) P_k (I - C F)^T + C (P^s_{k+1} + Q) C^T.

    At a hit P- holds the hit's wide jump, so that C is small there and little information passes it.
    """
    mean, covariance = record.mean.copy(), record.covariance.copy()
    identity = np.eye(mean.shape[1])
    for k in range(len(mean) - 2, record.start - 1, -1):
        F, P = record.transition[k + 1], record.covariance[k]
        C = _gain(P @ F.T, record.prior_covariance[k + 1])
        mean[k] = record.mean[k] + C @ (mean[k + 1] - record.prior_mean[k + 1])
        rest = identity - C @ F
        smoothed = rest @ P @ rest.T + C @ (covariance[k + 1] + record.noise[k + 1]) @ C.T
        covariance[k] = raised(smoothed, record.least)
    return mean, covariance


def _gain(cross: Array, covariance: Array) -> Array:
    """The product cross @ covariance^-1, with the covariance scaled to a correlation: entries span eight decades."""
    scale = 1.0 / np.sqrt(np.diagonal(covariance))
    correlation = covariance * np.outer(scale, scale)
    return np.asarray(np.linalg.solve(correlation, (cross * scale).T).T * scale)


def fly_back(
    model: BallModel, start: int, times: Array, noise: Array, fading: tuple[Array, Array], known: tuple[Array, Array]
) -> None:
    """Fills the states before sample `start`, in place, by free flight back from it.

    Args:
        model: the ball, with its coefficients in the state.  times: (n,) s.  known: means and covariances.
        noise: (n - 1, 9, 9), process noise of free flight over each interval.
        fading: (n - 1,) decay of the bias over each interval and (n - 1, b) m, the standard deviation of its new part,
            the same in both directions of time.
    """
    mean, covariance = known
    width = mean.shape[1] - fading[1].shape[1]
    for k in range(start - 1, -1, -1):
        after, jacobian = fly_jacobian(model, mean[k + 1 : k + 2, :width], times[k : k + 1] - times[k + 1])
        F = np.diag(np.full(len(mean[k]), fading[0][k]))
        F[:width, :width] = jacobian[0]
        widened = covariance[k + 1].copy()
        widened[:STATE_DIM, :STATE_DIM] += noise[k]
        mean[k, :width], mean[k, width:] = after[0], fading[0][k] * mean[k + 1, width:]
        covariance[k] = F @ widened @ F.T
        covariance[k, width:, width:] += np.diag(fading[1][k] ** 2)
        if not (np.isfinite(mean[k]).all() and np.isfinite(covariance[k]).all()):  # drag accelerates back in time
            mean[: k + 1], covariance[: k + 1] = np.nan, np.nan
            return
