"""Predicts new states of a window by an extended Kalman filter, as linearisation points."""

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import Sample
from ballfg.estimation.online.windows.interval import Interval
from ballfg.estimation.settings import Settings, stamp_covariance
from ballfg.factors.correlated_noise import BIAS_DIM, bias_step
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
        """Mean, covariance and whitened innovation after an interval and the sample at its end.

        Args:
            piece: (9, 1 + 9 + p) propagation from `point` (w,) and the coefficients `shared` (p,).
            mean, covariance: (w + p,) and (w + p, w + p) of state, bias and coefficients before.
            interval: between the samples.  sample: gets the rough velocity for its stamp's error.
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


def carried_with_bias(
    piece: Array, covariance: Array, bias: Array, dt: float, settings: Settings
) -> tuple[Array, Array]:
    """The propagation from a state, its bias and the coefficients to the next state with its bias, and its noise.

    Args:
        piece: (9, 1 + 9 + p) the propagated state and its Jacobian side by side.  covariance: (9, 9) of its noise.
        bias: (3,) m, at the linearisation point.  dt: s.  settings: with a memory.
    Returns: (12, 1 + 12 + p) and (12, 12).
    """
    width = STATE_DIM + BIAS_DIM
    decay, spread = bias_step(np.array([dt]), settings.bias_sigmas, settings.memory_time)
    carried, noise = np.zeros((width, piece.shape[1] + BIAS_DIM)), np.zeros((width, width))
    carried[:STATE_DIM, : 1 + STATE_DIM] = piece[:, : 1 + STATE_DIM]
    carried[:STATE_DIM, 1 + width :] = piece[:, 1 + STATE_DIM :]
    carried[STATE_DIM:, 0] = decay * bias
    carried[STATE_DIM:, 1 + STATE_DIM : 1 + width] = decay * np.eye(BIAS_DIM)
    noise[:STATE_DIM, :STATE_DIM], noise[STATE_DIM:, STATE_DIM:] = covariance, np.diag(spread[0] ** 2)
    return carried, noise


def without_bias(joint: Array, width: int) -> Array:
    """(9 + p, 9 + p) covariance of a state and the coefficients, from (w + p, w + p) with the bias between them."""
    if width == STATE_DIM:
        return joint
    kept = np.delete(np.arange(len(joint)), np.s_[STATE_DIM:width])
    return joint[np.ix_(kept, kept)]
