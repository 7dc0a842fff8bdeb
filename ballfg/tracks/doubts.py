"""Doubts about a track whose numbers can be metres and seconds, but perhaps not in this frame."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.state import STANDARD_GRAVITY, Z

Array = NDArray[np.float64]

BASELINE: Final = 0.05
"""s to each side over which an acceleration is read off: 3 mm of noise make 3 m/s^2 of one, 0.5 of a track's median."""
FALLS: Final = (0.4, 1.9)
"""Multiples of gravity between which a flying ball's vertical acceleration lies; strong topspin doubles it."""
LEAST_REVERSAL: Final = 0.8
"""m/s. A ball that falls and rises at least so fast, from one sample to a few later, has bounced."""
NEAR_SURFACE: Final = 0.08
"""m. Bounces farther from every declared surface are doubtful; a fast ball falls so far between two samples."""
AXES: Final = ("x", "y", "z")


def doubts_about(times: Array, positions: Array, surfaces: Sequence[float], radius: float) -> tuple[str, ...]:
    """What does not look like a ball that falls along -z and bounces on the declared surfaces.

    Args: times: (n,) s.  positions: (n, 3) m.  surfaces: heights, m.  radius: m, of the ball.
    Returns: one sentence for each doubt.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
    reach = max(round(BASELINE / step), 1) if np.isfinite(step) else 1
    if len(times) < 4 * reach:
        return ()
    return (*_other_axis(times, positions, reach), *_other_surface(times, positions, reach, surfaces, radius))


def _other_axis(times: Array, positions: Array, reach: int) -> tuple[str, ...]:
    before, middle, after = positions[: -2 * reach], positions[reach:-reach], positions[2 * reach :]
    span = (times[2 * reach :] - times[: -2 * reach]) / 2
    acceleration = np.median((after - 2 * middle + before) / span[:, None] ** 2, axis=0)
    low, high = FALLS[0] * STANDARD_GRAVITY, FALLS[1] * STANDARD_GRAVITY
    if abs(acceleration[Z]) >= low / 2:
        if -high <= acceleration[Z] < 0.0 or abs(acceleration[Z]) > high:
            return ()
        return ("the ball rises faster and faster along z: z seems to point down. Turn the sign of z.",)
    other = int(np.abs(acceleration[:2]).argmax())
    if not low <= abs(acceleration[other]) <= high:
        return ()
    return (f"the ball falls along {AXES[other]}, not along z: exchange the axes so that z points up.",)


def _other_surface(
    times: Array, positions: Array, reach: int, surfaces: Sequence[float], radius: float
) -> tuple[str, ...]:
    z = positions[:, Z]
    inner = np.arange(reach, len(z) - reach)
    fall = (z[inner] - z[inner - reach]) / (times[inner] - times[inner - reach])
    rise = (z[inner + reach] - z[inner]) / (times[inner + reach] - times[inner])
    lowest = np.array([z[i] == z[i - reach : i + reach + 1].min() for i in inner])
    bounces = z[inner[lowest & (fall < -LEAST_REVERSAL) & (rise > LEAST_REVERSAL)]] - radius
    if not len(bounces) or not len(surfaces):
        return ()
    gaps = np.abs(bounces[:, None] - np.array(surfaces)).min(axis=1)
    if np.median(gaps) <= NEAR_SURFACE:
        return ()
    heights = " and ".join(f"{height:g}" for height in surfaces)
    return (
        f"the ball bounces at z = {np.median(bounces):.2f} m, where no surface is declared (they are at {heights} m). "
        "Correct the table's height.",
    )
