"""Estimates a tracker's position noise from the distance of samples to smooth paths through their neighbours."""

from collections.abc import Iterable
from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ballfg.arrays import MAD_TO_SIGMA, Array, Mask, median
from ballfg.estimation.settings import LEAST_NOISE, Settings, sample_sigmas, total_sigmas
from ballfg.tracks import Track

HALF_WINDOW = 5  # Largest number of samples on each side of the tested one
LEAST_HALF_WINDOW = 3  # Fewer would leave a bounce in the window, or an outlier, nearly without residuals
DEGREE = 3  # Of the polynomials. Over `LONGEST_WINDOW` a flight differs from a cubic by less than 0.1 mm
LONGEST_WINDOW = 0.25  # s. Windows of slow trackers have fewer samples; windows with a gap are left out
REJECT = 5.0  # Windows with a residual above this many sigma hold a bounce, a hit or an outlier, and are left out
LEAST_CLEAN = 0.1
"""Share of windows without a residual beyond the stated noise that may be those without a bounce."""
ROUNDS = 4  # Repetitions of estimate and rejection; the first one rejects nothing
ENOUGH = 20_000  # Number of windows that gives sigma to 1 %; no further track is read
FLOOR = 2e-4  # m. Least noise of a tracker of flying balls; identical or computed positions would give zero
FALLBACK = 2e-3  # m. Noise of a camera tracker in a room: its prior median, and what counts without a window
FACTOR_FOUR = 1.4  # Standard deviation of a logarithm when only the order of magnitude is known
MAD_VARIANCE = 1.35
"""Variance of the logarithm of a robust sigma, times its number of windows: of cubics with white noise, 7 to 80 samples
at 30 to 200 Hz."""
COARSEST = 0.02  # m. Coordinates with a larger step in common are few places of a ball, not rounded ones
INTEGER = 1e-3  # Of a step: values in single precision are multiples of it within this
MOST_WINDOWS = 0.75  # Share of windows that dropped frames may not make too long; else windows have fewer samples
LEAST_LEFT = 1e-6
"""Least share of a sample's variance that a fit leaves: a sample far from all others determines the cubic alone."""
LOOKED_AT = 128
"""Number of samples of a track whose scatter is compared with the stated noise; they give it to some 10 %."""
LEAST_WINDOWS = 20  # Least number of windows for the scatter of a track
MOST_SCATTER = 1.75
"""Of the stated noise. Of 300 simulated tracks of each of nine kinds (seed 5; 60 to 200 Hz, with 5 % outliers or
jittering stamps) at most one in a hundred scatters so much."""


def estimate_position_noise(tracks: Iterable[Track]) -> Array:
    """The standard deviation of each coordinate, for data that does not state it.

    A cubic is fitted to each window of 11 samples, or 9 or 7 where a track is too slow or too short for more, without
    the middle one, and predicts that one. The residuals, divided by the growth of the noise in such a prediction, have
    the standard deviation sought; their median absolute value gives it regardless of a few bad ones. Windows with a
    bounce, a hit or an outlier are rejected.

    Noise with a memory longer than the window (calibration, a shifted tracker) does not show; stamp jitter does, along
    the flight.

    Args: tracks: read until there are enough windows.
    Returns: (3,) m, at least `FLOOR` and that of rounded coordinates; `FALLBACK` if no track has 7 samples within
        0.25 s, or if one bounce may be in all windows of a single track and makes their residuals larger than that.
    """
    blocks, count, size, rounding = list[Array](), 0, 0, np.zeros(3)
    for track in tracks:
        rounding = np.maximum(rounding, _rounding(track.positions))
        blocks.append(_window_residuals(track.seconds, track.positions, np.ones_like(track.positions)))
        count, size = count + len(blocks[-1]), 2 * _half_window(track.seconds) + 1
        if count >= ENOUGH:
            break
    usual = np.full(3, FALLBACK)
    residuals = np.concatenate([np.empty((0, 2, 3)), *blocks])
    alone = len(blocks) == 1  # one bounce may be in most windows, or in all
    if count == 0 or (alone and count <= size and _clean(residuals[:, 1], usual).mean() <= LEAST_CLEAN):
        return usual
    least = np.maximum(rounding, FLOOR)  # cubics follow the rounded places of a slow ball
    return np.maximum(_expected(*_robust_sigma(residuals, usual if alone else None)), least)


def _rounding(positions: Array) -> Array:
    """(3,) m, standard deviation of the rounding of coordinates (n, 3), where it lasts for some samples.

    It is 0 unless all are multiples of one step, with at most half as many values as samples.
    """
    found = np.zeros(3)
    for axis, coordinates in enumerate(positions.T):
        values = np.unique(coordinates)
        apart = np.diff(values)
        step = apart.min(initial=COARSEST)
        multiples = apart / step
        lasts = step < COARSEST and 2 * len(values) <= len(coordinates)
        if lasts and (np.abs(multiples - np.rint(multiples)) < INTEGER).all():
            found[axis] = step / np.sqrt(12.0)
    return found


def _expected(sigma: Array, count: int) -> Array:
    """(3,) m, root of the expected variance for a robust sigma (3,) of some windows, each axis by itself.

    The prior of its logarithm is `FACTOR_FOUR` about `FALLBACK`: few windows may lie close to their cubics by chance.
    """
    prior = 1.0 / FACTOR_FOUR**2
    variance = 1.0 / (count / MAD_VARIANCE + prior)
    shown = np.log(np.maximum(sigma, LEAST_NOISE))
    mean = variance * (shown * count / MAD_VARIANCE + np.log(FALLBACK) * prior)
    return np.asarray(np.exp(mean + variance))


def noise_doubts(track: Track, settings: Settings) -> tuple[str, ...]:
    """One sentence if positions scatter far more than the settings say; for `Estimate.notes`.

    If the stated noise is too small, covariances are too small and good samples are taken for events. The first
    `LOOKED_AT` samples show it; rough positions, and tracks of fewer than `LEAST_WINDOWS` windows, do not.
    """
    first = slice(0, LOOKED_AT)
    times, positions = track.seconds[first], track.positions[first]
    if track.rough or len(times) < LEAST_WINDOWS + 2 * LEAST_HALF_WINDOW:
        return ()
    white = sample_sigmas(settings, len(times), None if track.sigmas is None else track.sigmas[first])
    stated = total_sigmas(settings, white, partial(np.gradient, positions, times, axis=0))
    residuals = _window_residuals(times, positions, stated)
    if len(residuals) < LEAST_WINDOWS:
        return ()
    usual = median(stated)
    shown, _ = _robust_sigma(residuals * usual, usual)
    seen, said = (float(np.sqrt(np.square(s).mean())) for s in (shown, usual))
    if seen <= MOST_SCATTER * said:
        return ()
    remedy = "State position_noise (ballfg noise finds it)." if track.sigmas is None else "State larger ones."
    return (
        f"the positions scatter by {1e3 * seen:.2g} mm where the settings say {1e3 * said:.2g} mm: sigmas are "
        f"too small, and good samples may be set aside. {remedy}",
    )


def _window_residuals(times: Array, positions: Array, sigmas: Array) -> Array:
    """(w, 2, 3) the middle residual of the cubic through each window, and the size of its largest one.

    They are in the standard deviations sigmas (n, 3) of one sample.

    With the projection P = 1 - B B^T a residual r_i has the variance sum_j P_ij^2 sigma_j^2; for equal sigmas that is
    sigma^2 (1 - h) with h the leverage. Predicted without its own sample it is larger by 1 / (1 - h), so that
    r / sqrt(1 - h) standardises either of them.
    """
    half = _half_window(times)
    size = 2 * half + 1
    if half < LEAST_HALF_WINDOW:
        return np.empty((0, 2, 3))
    stamps = sliding_window_view(times, size)
    short = stamps[:, -1] - stamps[:, 0] <= LONGEST_WINDOW
    stamps = stamps[short]
    centre = stamps[:, half, None]
    scaled = (stamps - centre) / (stamps[:, -1:] - stamps[:, :1])
    basis, _ = np.linalg.qr(scaled[..., None] ** np.arange(DEGREE + 1))
    left = np.eye(size) - basis @ basis.transpose(0, 2, 1)
    values, variances = (
        sliding_window_view(each, size, axis=0)[short].transpose(0, 2, 1) for each in (positions, sigmas**2)
    )
    residuals = left @ values / np.sqrt(np.maximum(left**2 @ variances, LEAST_LEFT * median(sigmas**2)))
    return np.stack((residuals[:, half], np.abs(residuals).max(axis=1)), axis=1)


def _half_window(times: Array) -> int:
    """Number of samples on each side of the tested one.

    As many as leave more windows than can hold one bounce, and most of them no longer than 0.25 s; else it is
    `LEAST_HALF_WINDOW`, and 0 for a track without a window.
    """
    if len(times) < 2 * LEAST_HALF_WINDOW + 1:
        return 0
    for half in range(min(HALF_WINDOW, (len(times) - 2) // 4), LEAST_HALF_WINDOW, -1):
        if (times[2 * half :] - times[: -2 * half] <= LONGEST_WINDOW).mean() > MOST_WINDOWS:
            return half
    return LEAST_HALF_WINDOW


def _robust_sigma(residuals: Array, stated: Array | None = None) -> tuple[Array, int]:
    """(3,) m from window residuals (w, 2, 3): MAD of the middle ones of windows without large ones; their number.

    Args: stated: (3,) m. What is large is judged by it first, if some windows have nothing so large: bounces that are
        in most windows do not count as noise then.
    """
    middle, largest = residuals[:, 0], residuals[:, 1]
    sigma = MAD_TO_SIGMA * median(np.abs(middle))
    if stated is not None and _clean(largest, stated).mean() > LEAST_CLEAN:
        sigma = stated
    count = len(middle)
    for _ in range(ROUNDS - 1):
        clean = _clean(largest, sigma)
        if not clean.any():
            break
        sigma, count = MAD_TO_SIGMA * median(np.abs(middle[clean])), int(clean.sum())
    return np.asarray(sigma), count


def _clean(largest: Array, sigma: Array) -> Mask:
    """(w,) bool, windows whose largest residuals (w, 3) are not beyond some noise (3,)."""
    return np.asarray((largest <= REJECT * np.maximum(sigma, FLOOR)).all(axis=1))
