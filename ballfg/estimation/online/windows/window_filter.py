"""A Kalman filter steps over the newest samples of a window, in machine code, to give their linearisation points."""

import math

import numpy as np

from ballfg.arrays import Array, plain
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FLAG, NOTHING, ONE, REAL, TWO
from ballfg.estimation.noise.filter_code import innovate, multiply, update
from ballfg.estimation.online.state import Sample
from ballfg.estimation.online.windows.interval import Interval
from ballfg.estimation.settings import Settings
from ballfg.factors.correlated_noise import BIAS_DIM, bias_step
from ballfg.factors.loss import weight_of
from ballfg.state import STATE_DIM, VELOCITY

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
        Raises: RuntimeError: if the covariance of the innovation is not positive definite.
        """
        carried, noise = piece, interval.covariance
        if self.biased:
            dt = float(interval.batch.dt[0])
            carried, noise = carried_with_bias(piece, noise, point[STATE_DIM:], dt, self.settings)
        covariance = plain(covariance)  # GTSAM's has its columns one behind another
        after, spread = np.empty_like(mean), np.empty_like(covariance)
        _predict(carried, noise, point, shared, mean, covariance, after, spread)
        if np.trace(spread[VELOCITY, VELOCITY]) < WIDE_VELOCITY**2:
            sample.velocity = after[VELOCITY].copy()
        innovation = np.empty(3)
        if sample.measured:
            loss, way = self.settings.loss, self.settings.stamp_jitter * sample.velocity
            errors = (plain(sample.sigma), way, loss.kind, loss.scale)
            if not _correct(plain(sample.position), *errors, self.width, innovation, after, spread):
                raise RuntimeError("the covariance of a sample's innovation is not positive definite")
        for measurement in sample.measurements:
            after, spread = measurement.corrected(after, spread)
        return after, spread, innovation if sample.measured else sample.measurements[0].innovation


@machine_code(NOTHING(TWO, TWO, ONE, ONE, ONE, TWO, ONE, TWO))
def _predict(
    carried: Array,
    noise: Array,
    point: Array,
    shared: Array,
    mean: Array,
    covariance: Array,
    after: Array,
    spread: Array,
) -> None:
    """Carries a mean (w + p,) and its covariance over an interval; writes `after` and `spread`.

    Args:
        carried: (w, 1 + w + p) the point (w,) and the coefficients `shared` (p,) after it, and the Jacobian.
        noise: (w, w) covariance that the interval adds.
    """
    w, d = len(point), len(mean)
    transition, half = np.eye(d), np.empty((d, d))
    for i in range(w):
        after[i] = carried[i, 0]
        for j in range(d):
            transition[i, j] = carried[i, 1 + j]
            after[i] += transition[i, j] * (mean[j] - (point[j] if j < w else shared[j - w]))
    after[w:] = mean[w:]
    multiply(transition, covariance, half)
    multiply(half, np.ascontiguousarray(transition.T), spread)
    for i in range(w):
        for j in range(w):
            spread[i, j] += noise[i, j]


@machine_code(FLAG(ONE, ONE, ONE, COUNT, REAL, COUNT, ONE, ONE, TWO))
def _correct(
    position: Array,
    sigma: Array,
    way: Array,
    kind: int,
    scale: float,
    width: int,
    innovation: Array,
    mean: Array,
    covariance: Array,
) -> bool:
    """Corrects a mean (w + p,) and its covariance by a measured position (3,) m; False if it is not definite.

    Args:
        sigma: (3,) m, of the white error.  way: (3,) m, of the ball during the standard deviation of a stamp's error.
        kind, scale: of the loss, which reduces the weight of a far sample.
        width: w; a bias is measured beside the position if it exceeds that of a state.
    Writes: innovation (3,), whitened, before the loss; mean; covariance.
    """
    d = len(mean)
    bias, measured = STATE_DIM if width > STATE_DIM else d, np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            measured[a, b] = way[a] * way[b] + (sigma[a] * sigma[a] if a == b else 0.0)
    seen, root, weighted = np.empty((d, 3)), np.empty((3, 3)), np.empty(3)
    square = innovate(bias, mean, covariance, position, measured, seen, root, innovation, weighted)
    weight, used = weight_of(kind, scale, square), innovation
    if weight != 1.0:
        measured /= weight
        used = np.empty(3)
        square = innovate(bias, mean, covariance, position, measured, seen, root, used, weighted)
    if math.isnan(square):
        return False
    update(seen, root, used, mean, covariance, np.empty((d, 3)))
    return True


def carried_with_bias(
    piece: Array, covariance: Array, bias: Array, dt: float, settings: Settings
) -> tuple[Array, Array]:
    """The propagation from a state, its bias and the coefficients to the next state with its bias, and its noise.

    Args:
        piece: (9, 1 + 9 + p) the propagated state and its Jacobian side by side.  covariance: (9, 9) of its noise.
        bias: (3,) m, at the linearisation point.  dt: s.  settings: with a memory.
    Returns: (12, 1 + 12 + p) and (12, 12).
    """
    width, bias_sigmas = STATE_DIM + BIAS_DIM, settings.bias_sigmas
    (decay,), (spread,) = bias_step(np.array([dt]), bias_sigmas, settings.memory_time)
    carried, noise = np.zeros((width, piece.shape[1] + BIAS_DIM)), np.zeros((width, width))
    carried[:STATE_DIM, : 1 + STATE_DIM] = piece[:, : 1 + STATE_DIM]
    carried[:STATE_DIM, 1 + width :] = piece[:, 1 + STATE_DIM :]
    noise[:STATE_DIM, :STATE_DIM] = covariance
    for k in range(STATE_DIM, width):
        carried[k, 0], carried[k, 1 + k] = decay * bias[k - STATE_DIM], decay
        noise[k, k] = spread[k - STATE_DIM] ** 2
    return carried, noise
