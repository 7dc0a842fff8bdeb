"""Tests positions quickly for white noise, for a fall of all of them, and for a filter that smoothed them."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.estimation.segmentation.physics import SegmentationPhysics

CALM: Final = 0.3  # Share of the samples that show the noise: others are near bounces, throws and catches
CALM_QUANTILE: Final = 0.3853  # Its quantile of the absolute value of a standard normal variable
WINDOW: Final = 0.12  # s, of the fit of an acceleration
LEAST_WINDOW: Final = 5  # Samples, likewise, at least
MOST_OFF: Final = 20.0
"""Squared whitened distance of an acceleration from that of a ball, of 3 degrees of freedom: one in 6,000 is larger."""
CLEARLY: Final = 3.0  # Multiple of that distance at which a ball at rest would have to stand for a window to tell
BESIDE: Final = 0.04
"""s. Windows with a bounce or a hit do not fall, for the length of a window and this; longer means something else."""
AT_END: Final = 0.05  # s, likewise where a track begins or ends
STILL_AIR: Final = 0.7  # m/s^2. Spread of the acceleration of a slow flying ball beside gravity and drag
AIR: Final = 1.25
"""Its growth, over the ball's own drag: lift of a spinning ball, and drag of another ball than assumed."""
BLOCK: Final = 20_000  # Samples that are looked at together; memory grows with it


def contrasts(times: Array) -> Array:
    """(n - 4, 5) weights of length one of five neighbours that leave nothing of a cubic; times (n,) s."""
    stamps = sliding_window_view(times, 5)
    apart = stamps[:, :, None] - stamps[:, None, :]
    apart = apart / np.abs(apart).max(axis=(1, 2), keepdims=True) + np.eye(5)
    weights = 1.0 / np.prod(apart, axis=2)
    return np.asarray(weights / np.linalg.norm(weights, axis=1, keepdims=True))


def scatter(times: Array, positions: Array) -> Array:
    """(3,) m, white noise of each coordinate: what cubics through five neighbours leave, of the calmer samples.

    Args: times: (n,) s, n >= 5.  positions: (n, 3) m.
    """
    left = np.abs(np.einsum("ni,nxi->nx", contrasts(times), sliding_window_view(positions, 5, axis=0)))
    return np.asarray(np.quantile(left, CALM, axis=0) / CALM_QUANTILE)


def falls_throughout(times: Array, positions: Array, sigma: Array, physics: SegmentationPhysics) -> bool:
    """True if all of a track falls like a ball, apart from lone bounces and hits: then nothing holds the ball.

    The acceleration of short windows is compared with gravity and drag. False does not say the contrary.

    Args: times: (n,) s.  positions: (n, 3) m.  sigma: (3,) m, white noise.  physics: of the ball.
    """
    if len(times) < LEAST_WINDOW:
        return True
    step = float(np.median(np.diff(times)))
    size = max(LEAST_WINDOW, round(WINDOW / step) + 1)
    if len(times) < size:
        return True
    falling = np.concatenate([*_falling(times, positions, sigma, physics, size)])
    ends = np.flatnonzero(np.diff(falling, prepend=True, append=True))
    for first, stop in ends.reshape(-1, 2):
        at_end = first == 0 or stop == len(falling)
        lasts = times[min(stop, len(falling) - 1)] - times[first]
        if lasts > (AT_END if at_end else WINDOW + BESIDE + 2.0 * step):
            return False
    return True


def _falling(
    times: Array, positions: Array, sigma: Array, physics: SegmentationPhysics, size: int
) -> Iterator[NDArray[np.bool_]]:
    """(n - size + 1,) in blocks: whether each window of `size` samples falls like a ball, and would show if not."""
    for begin in range(0, len(times) - size + 1, BLOCK):
        part = slice(begin, begin + BLOCK + size - 1)
        stamps = sliding_window_view(times[part], size)
        reach = 0.5 * (stamps[:, -1:] - stamps[:, :1])
        scaled = (stamps - stamps.mean(axis=1, keepdims=True)) / reach
        design = np.stack((np.ones_like(scaled), scaled, scaled**2), axis=1)
        unscaled = np.linalg.inv(design @ design.transpose(0, 2, 1))
        fitted = unscaled @ (design @ sliding_window_view(positions[part], size, axis=0).transpose(0, 2, 1))
        velocity, pull = fitted[:, 1] / reach, 2.0 * fitted[:, 2] / reach**2
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        noise = 2.0 * np.sqrt(unscaled[:, 2, 2, None]) / reach**2 * sigma
        off = pull + physics.drag * speed * velocity + np.array([0.0, 0.0, physics.gravity])
        spread = noise**2 + (STILL_AIR + AIR * physics.drag * speed**2) ** 2
        telling = (noise[:, 2] ** 2 + STILL_AIR**2) * CLEARLY * MOST_OFF < physics.gravity**2
        yield telling & ((off**2 / spread).sum(axis=1) < MOST_OFF)
