"""Predicts new states of a window by an extended Kalman filter, as linearisation points."""

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import Sample
from ballfg.estimation.online.windows.interval import Interval
from ballfg.estimation.online.windows.linear import carried_with_bias
from ballfg.estimation.settings import Settings, stamp_covariance
from ballfg.factors.correlated_noise import BIAS_DIM
from ballfg.factors.linear.definite import whitened as whitened_by
from ballfg.state import POSITION, STATE_DIM, VELOCITY

WIDE_VELOCITY = 1.0
"""m/s. A less certain predicted velocity does not give the direction of a stamp's error."""


class WindowFilter:
    """One step at a time over states of a window, with coefficients behind them.

    Its result is a linearisation point only: closer to the final solution than the prediction, it saves
    relinearisations, and a robust loss gets a weight near its final one.

    Args: settings: noise.  width: w, 9, or 12 if the tracker's bias follows each state.
    """

    def __init__(self, settings: Settings, width: int) -> None:
        self.settings, self.width, self.biased = settings, width, width > STATE_DIM

    def step(
        self,
        piece: Array,
        point: Array,
        mean: Array,
        shared: Array,
        covariance: Array,
        interval: Interval,
        sample: Sample,
    ) -> tuple[Array, Array, Array]:
        """Predicts over an interval and updates with the sample at its end.

        Args:
            piece: (9, 1 + 9 + p) propagation from `point` (w,) and the coefficients `shared` (p,).
            mean, covariance: (w + p,) and (w + p, w + p) of state, bias and coefficients before.
            interval: between the samples.  sample: gets the rough velocity for its stamp's error.
        Returns: mean and covariance after the sample, and its whitened innovation.
        """
        carried, noise, w = piece, interval.covariance, self.width
        if self.biased:
            dt = float(interval.batch.dt[0])
            carried, noise = carried_with_bias(piece, noise, point[STATE_DIM:], dt, self.settings)
        F = carried[:, 1:]
        predicted, spread = np.empty_like(mean), np.empty_like(covariance)
        predicted[:w] = carried[:, 0] + F @ (mean - np.concatenate((point, shared)))
        predicted[w:] = mean[w:]
        moved = F @ covariance
        spread[:w, :w] = moved @ F.T + noise
        spread[:w, w:], spread[w:, :w], spread[w:, w:] = moved[:, w:], moved[:, w:].T, covariance[w:, w:]
        if np.trace(spread[VELOCITY, VELOCITY]) < WIDE_VELOCITY**2:
            sample.velocity = predicted[VELOCITY]
        return self._with(sample, predicted, spread)

    def _with(self, sample: Sample, mean: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Mean and covariance after the update by a sample, and its whitened innovation."""
        if not sample.measured:
            for measurement in sample.measurements:
                mean, covariance = measurement.corrected(mean, covariance)
            return mean, covariance, sample.measurements[0].innovation
        innovation = sample.position - self._measured_part(mean)
        noise = np.diag(sample.sigma**2) + stamp_covariance(self.settings, sample.velocity)
        rows = self._measured_part(covariance)
        spread = self._measured_part(rows.T)
        whitened = whitened_by(innovation, spread + noise)
        if self.settings.loss.name != "squared":
            noise = noise / self.settings.loss.weight(np.array([np.linalg.norm(whitened)]))
        gain = np.linalg.solve(spread + noise, rows)
        mean, covariance = mean + innovation @ gain, covariance - rows.T @ gain
        for measurement in sample.measurements:
            mean, covariance = measurement.corrected(mean, covariance)
        return mean, covariance, whitened

    def _measured_part(self, rows: Array) -> Array:
        """(3, ...) the sum of the position and bias rows of (w + p, ...), which a measured position depends on."""
        return rows[POSITION] + rows[STATE_DIM : STATE_DIM + BIAS_DIM] if self.biased else rows[POSITION]
