"""Tests for whiteness along the tracks: neighbouring errors correlate if the motion differs from the model.

Residuals of a good fit are not white themselves; docs/derivations/diagnosis.md has the statistic U that allows for it.
Errors of a tracker with known memory or jitter are whitened by their covariance first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, stats

from ballfg.arrays import Array, Mask
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.system import System
from ballfg.state import STATE_DIM
from ballfg.tracks.noise import TrackNoise

REACHES = (0.02, 0.06, 0.18)
"""s. Widths of the Gaussian kernels in the time between two samples: from a contact's duration to an arc's."""
LEAST_WEIGHT = 0.5  # Samples with a smaller robust weight are outliers: their products carry no information on drift
LEAST_SIZE = 1e-6  # Least relative size of a direction among the columns of a stretch: less is rounding
LEAST_FREEDOM = 1e-6  # Least degrees of freedom of a stretch; one whose samples are all outliers has none


@dataclass(frozen=True)
class Whiteness:
    """The test."""

    p_value: float  # One-sided, corrected for the number of reaches
    reach: float  # s, of the most significant kernel
    drift: float
    """m, root of the mean product of such pairs' errors: the common part of neighbouring samples."""
    explained: Array  # For each reach, the sum of U
    spread: Array  # For each reach, its standard deviation without drift

    @property
    def where(self) -> str:
        """The time and size of the common error, in words."""
        return f"time: samples within {1e3 * self.reach:.0f} ms err alike, by {1e3 * self.drift:.2g} mm"


def whiteness(fit: Fit, system: System, tracker: TrackNoise | None = None, own: Sequence[int] = ()) -> Whiteness:
    """The test of a fit for drift along its tracks, from its system, linearised at its minimum.

    Args:
        tracker: white noise, memory and jitter of the tracker; None: errors are assumed white.
        own: columns of shared unknowns of which each stretch has its own value.
    """
    stretches = fit.problem.stretches
    n, k = stretches.times.shape
    kept = stretches.used.numpy() & (fit.robust.samples >= LEAST_WEIGHT)
    rows = np.ones(system.residual.shape)  # without outliers, whose pull on the fit would look like drift
    rows[:, : 3 * k] = np.repeat(kept, 3, axis=1)
    system = replace(
        system,
        residual=system.residual * rows,
        by_start=system.by_start * rows[..., None],
        by_common=system.by_common * rows[..., None],
    )
    if tracker is not None:  # the fit has weighted its samples as if their errors were white
        system = _whitened(fit, system, kept, tracker)
    local = _directions(np.concatenate((system.by_start, system.by_common[..., list(own)]), axis=-1))
    projected = system.columns - local @ (local.swapaxes(-1, -2) @ system.columns)
    if tracker is not None:
        projected[..., -1] -= projected[..., :-1] @ _common_step(fit, system)
    residual = projected[:, : 3 * k, -1].reshape(n, k, 3)
    taken = _absorbed(fit, local, projected[..., :-1]).reshape(n, k, 3, -1)
    sums, spreads, p_values, products = [], [], [], []
    for reach in REACHES:
        times, sample = stretches.times.numpy(), np.arange(k)
        kernel = np.exp(-0.5 * ((times[:, :, None] - times[:, None, :]) / reach) ** 2)
        kernel *= kept[:, :, None] & kept[:, None, :]
        kernel[:, sample, sample] = 0.0  # pairs of different samples
        total, variance, third = _summed(residual, taken, kept, kernel)
        sums.append(total)
        spreads.append(np.sqrt(max(variance, 0.0)))
        p_values.append(_p_value(total, variance, third))
        products.append(total / (3.0 * kernel.sum()))
    most = int(np.argmin(p_values))
    sigma = float(np.sqrt((fit.sigmas[stretches.used.numpy()] ** 2).mean()))
    return Whiteness(
        p_value=min(1.0, len(REACHES) * p_values[most]),
        reach=REACHES[most],
        drift=sigma * float(np.sqrt(max(0.0, products[most]))),
        explained=np.array(sums),
        spread=np.array(spreads),
    )


def _p_value(total: float, variance: float, third: float) -> float:
    """Probability of sums this large by chance; 1 if the fit has absorbed all scatter."""
    if not variance > 0.0:
        return 1.0
    return float(stats.pearson3.sf(total / np.sqrt(variance), third / variance**1.5))


def _whitened(fit: Fit, system: System, kept: Mask, tracker: TrackNoise) -> System:
    """The rows of positions, transformed so that the errors of a tracker with memory and jitter are white."""
    stretches = fit.problem.stretches
    stated = stretches.sigmas.numpy()
    typical = np.median(stated[stretches.used.numpy()], axis=0)
    assert tracker.position is not None
    white = np.where(kept[..., None], stated / typical * tracker.position, 1.0)
    rows = np.concatenate((system.columns, system.by_start), axis=-1)
    metres, times = np.where(kept[..., None], fit.sigmas, 1.0), stretches.times.numpy()
    for number, count in enumerate(stretches.used.numpy().sum(axis=1).tolist()):
        some, own = kept[number, :count], np.s_[number, : 3 * count]
        spread = _spread(times[number, :count], fit.predicted.positions[number, :count], some, tracker)
        spread[np.diag_indices(3 * count)] += white[number, :count].ravel() ** 2
        right = metres[number, :count].reshape(-1, 1) * rows[own]
        rows[own] = linalg.solve_triangular(np.linalg.cholesky(spread), right, lower=True, check_finite=False)
    by_common, residual, by_start = np.split(rows, (rows.shape[-1] - STATE_DIM - 1, -STATE_DIM), axis=-1)
    return replace(system, residual=residual[..., 0], by_start=by_start, by_common=by_common)


def _spread(times: Array, positions: Array, kept: Mask, tracker: TrackNoise) -> Array:
    """(3 k, 3 k) covariance of what memory and jitter add to samples, zero but for those that are kept.

    Args: times: (k,) s.  positions: (k, 3) m, predicted.  kept: (k,).
    """
    k, sample = len(times), np.arange(len(times))
    spread = np.zeros((k, 3, k, 3))
    if tracker.memory is not None and tracker.memory_time is not None:
        lasting = np.exp(-np.abs(times[:, None] - times) / tracker.memory_time) * np.outer(kept, kept)
        for axis in range(3):
            spread[:, axis, :, axis] = tracker.memory[axis] ** 2 * lasting
    if tracker.stamp_jitter is not None:
        velocities = np.diff(positions, axis=0) / np.diff(times)[:, None]
        way = tracker.stamp_jitter * np.concatenate((velocities, velocities[-1:])) * kept[:, None]
        spread[sample, :, sample, :] += way[:, :, None] * way[:, None, :]
    return spread.reshape(3 * k, 3 * k)


def _common_step(fit: Fit, system: System) -> Array:
    """(q,) change of the shared unknowns under the weights of another system."""
    problem, values = fit.problem, np.array([fit.unknowns.values[name] for name in fit.problem.free])
    away = np.concatenate((problem.centres - values, -fit.unknowns.launcher.ravel()))
    free = np.full(len(away), np.inf)
    return system.eliminated().common_step(problem.common_precision, problem.common_precision * away, -free, free)


def _summed(residual: Array, taken: Array, kept: Mask, kernel: Array) -> tuple[float, float, float]:
    """Sum of U over stretches, its variance and third cumulant without drift, from residuals (n, k, 3).

    Args: taken: (n, k, 3, d) directions that the fit absorbs.  kept: (n, k) samples that count.  kernel: (n, k, k).
    """
    freedom = 3.0 * kept.sum(axis=1) - (taken**2).sum(axis=(1, 2, 3))
    tells = freedom > LEAST_FREEDOM
    if not tells.any():
        return 0.0, 0.0, 0.0
    residual, taken, kernel, freedom = residual[tells], taken[tells], kernel[tells], freedom[tells]
    n, k, _ = residual.shape
    rows, once = taken.reshape(n, 3 * k, -1), kernel @ taken.reshape(n, k, -1)
    moved = once.reshape(n, 3 * k, -1)
    inner = rows.swapaxes(-1, -2) @ moved
    squared = moved.swapaxes(-1, -2) @ moved
    cubed = moved.swapaxes(-1, -2) @ (kernel @ once).reshape(n, 3 * k, -1)
    first = -_trace(inner)
    second = 3.0 * (kernel**2).sum(axis=(1, 2)) - 2.0 * _trace(squared) + (inner**2).sum(axis=(1, 2))
    third = 3.0 * ((kernel @ kernel) * kernel).sum(axis=(1, 2)) - 3.0 * _trace(cubed)
    third += 3.0 * (squared * inner).sum(axis=(1, 2)) - _trace(inner @ inner @ inner)
    c = -first / freedom
    variance = 2.0 * (second + 2.0 * c * first + c**2 * freedom)
    skew = 8.0 * (third + 3.0 * c * second + 3.0 * c**2 * first + c**3 * freedom)
    scale = (residual**2).sum(axis=(1, 2)) / freedom
    products = residual @ residual.swapaxes(-1, -2)
    sums = (kernel * products).sum(axis=(1, 2)) / scale + c * freedom
    # noise that differs from sample to sample (jitter on a fast ball) raises the variance
    seen = (kernel**2 * products**2).sum(axis=(1, 2)) / scale**2
    uneven = max(1.0, float(seen.sum() / (3.0 * (kernel**2).sum())))
    return float(sums.sum()), uneven * float(variance.sum()), uneven**1.5 * float(skew.sum())


def _trace(matrices: Array) -> Array:
    return np.asarray(np.trace(matrices, axis1=-2, axis2=-1))


def _directions(columns: Array) -> Array:
    """(n, m, d) orthogonal directions of unit length of columns (n, m, d) in each stretch; zero for missing ones."""
    length = np.linalg.norm(columns, axis=1, keepdims=True)
    found, sizes, _ = np.linalg.svd(columns / np.where(length > 0.0, length, 1.0), full_matrices=False)
    return np.asarray(found * (sizes > LEAST_SIZE * sizes.max(axis=-1, keepdims=True))[:, None])


def _absorbed(fit: Fit, local: Array, shared: Array) -> Array:
    """(n, 3 k, d + q) directions of the samples' noise that local (n, m, d) and shared unknowns (n, m, q) absorb.

    They have unit length, over the rows of a stretch and over all rows; local ones are projected out of the shared.
    """
    precision = (shared.swapaxes(-1, -2) @ shared).sum(axis=0) + np.diag(fit.problem.common_precision)
    root = np.linalg.inv(np.linalg.cholesky(precision)).T
    return np.concatenate((local, shared @ root), axis=-1)[:, :-3]
