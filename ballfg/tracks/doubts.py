"""Doubts that a track is that of a ball in this frame: its axes, its clock and unit, the heights of its bounces."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ballfg.arrays import MAD_TO_SIGMA, Array, median, quadratics
from ballfg.state import STANDARD_GRAVITY, Z

BASELINE: Final = 0.05  # s to each side for an acceleration: 3 mm of noise leave 3 m/s^2, in a track's median 0.5
LEAST_FALLING: Final = 0.2  # least share of a track that falls along -z as a ball does, for undoubted axes
MOSTLY: Final = 0.5  # share of a track that falls along +z, above which z seems to point down
FALLS: Final = (0.4, 1.9)  # gravities between which a flying ball's vertical acceleration lies; topspin doubles it
LEAST_FALL: Final = 0.1  # gravities. A ball that falls more slowly rolls, lies still or is held
LEAST_OFF: Final = 0.5
"""Gravities by which that of a doubtful clock or unit differs, beside what air can do: with 0.3 a track of
`robot_rallies` was doubted; `strokes`, `spindoe`, `aimy`, `ballgun` are silent with either."""
ALIKE: Final = 0.7  # least share of the windows that fall about alike, as no hand moves a ball
QUIET: Final = 2.0  # times the residual of a quarter of the windows, up to which another has no bounce
MOST_LIFT: Final = 1.5  # times the drag: what air adds to the vertical acceleration at most
LEAST_REVERSAL: Final = 0.8  # m/s. A ball that falls and then rises at least so fast within a few samples has bounced
SURELY: Final = 4.0  # standard deviations of those velocities by which they must exceed it
NEAR_SURFACE: Final = 0.03
"""m from every declared surface beyond which a bounce is doubtful. Medians of tracks of `aimy` and `ballgun` lie within
12 mm; `robot_rallies` and `strokes`, which did not choose it, within 9."""
LEAST_BOUNCES: Final = 3  # at one height, that show a surface where none is declared
AXES: Final = ("x", "y", "z")


def doubts_about(
    times: Array, positions: Array, surfaces: Sequence[float], radius: float, drag: float = 0.0
) -> tuple[str, ...]:
    """Doubts that a ball, of times (n,) s and positions (n, 3) m, falls along -z and bounces on the surfaces (m).

    Args: radius: m.  drag: 1/m, k in a = -k |v| v.
    """
    step = float(median(np.diff(times))) if len(times) > 1 else np.inf
    reach = max(round(BASELINE / step), 1) if np.isfinite(step) else 1
    if len(times) <= 4 * reach:
        return ()
    frame = _other_axis(times, positions, reach) or _other_clock(times, positions, reach, drag)
    return (*frame, *_other_surface(times, positions[:, Z], reach, surfaces, radius))


def _other_axis(times: Array, positions: Array, reach: int) -> tuple[str, ...]:
    before, middle, after = positions[: -2 * reach], positions[reach:-reach], positions[2 * reach :]
    span = (times[2 * reach :] - times[: -2 * reach]) / 2
    accelerations = (after - 2 * middle + before) / span[:, None] ** 2
    velocities = (after - before) / (2.0 * span[:, None])
    acceleration = median(accelerations)
    low, high = FALLS[0] * STANDARD_GRAVITY, FALLS[1] * STANDARD_GRAVITY
    falls = (-high <= accelerations[:, Z]) & (accelerations[:, Z] <= -low)
    rises = (low <= accelerations[:, Z]) & (accelerations[:, Z] <= high)
    if falls.mean() >= LEAST_FALLING:  # in a short track a bounce outweighs its flights in the median
        return ()
    if rises.mean() >= MOSTLY:
        return ("the ball rises faster and faster along z: z seems to point down. Turn the sign of z.",)
    other = int(np.abs(acceleration[:2]).argmax())
    faster = (velocities[:, other] * acceleration[other] > 0.0).mean()  # drag makes a ball slower only
    if abs(acceleration[Z]) < low / 2 and low <= abs(acceleration[other]) <= high and faster >= LEAST_FALLING:
        return (f"the ball falls along {AXES[other]}, not along z: exchange the axes so that z points up.",)
    return ()


def _other_clock(times: Array, positions: Array, reach: int, drag: float) -> tuple[str, ...]:
    size = 4 * reach + 1
    stamps = sliding_window_view(times, size)[::reach]
    ways = sliding_window_view(positions, size, axis=0)[::reach].swapaxes(1, 2)
    found, variances = quadratics(stamps, ways)
    quiet = variances <= QUIET**2 * np.percentile(variances, 25.0)  # without a bounce or a hit
    falls, velocities = -2.0 * found[quiet, 0, Z], found[quiet, 1]
    fall, air = float(median(falls)), MOST_LIFT * drag * float(median((velocities**2).sum(axis=1)))
    alike = ((0.5 * fall < falls) & (falls < 2.0 * fall)).mean()
    off = abs(fall - STANDARD_GRAVITY) - air
    if fall < LEAST_FALL * STANDARD_GRAVITY or off < LEAST_OFF * STANDARD_GRAVITY or alike < ALIKE:
        return ()
    return (
        f"the ball falls with {fall:.3g} m/s^2 in place of {STANDARD_GRAVITY:.3g}: check the stamps (the rate of the "
        "frames) and the unit of the positions.",
    )


def _other_surface(
    times: Array, heights: Array, reach: int, surfaces: Sequence[float], radius: float
) -> tuple[str, ...]:
    contacts, within = _contacts(times, heights, reach)
    if not len(contacts):
        return ()
    height = round(float(median(contacts)) - radius, 2) + 0.0  # no minus sign before a zero
    bounced = f"the ball bounces at z = {height:.2f} m"
    if not len(surfaces):
        low, high = np.percentile(contacts, (25.0, 75.0))
        if len(contacts) < LEAST_BOUNCES or high - low > NEAR_SURFACE:
            return ()  # hands and rackets hit a ball at any height
        return (f"{bounced}, and no surface is declared. Give the table's or the floor's height.",)
    off = contacts[:, None] - radius - np.array(surfaces)
    beyond = np.maximum(np.maximum(off - within[:, None], -off), 0.0).min(axis=1)
    if median(beyond) <= NEAR_SURFACE:
        return ()
    declared = " and ".join(f"{height:g}" for height in surfaces)
    return (f"{bounced}, where no surface is declared (they are at {declared} m). Correct the table's height.",)


def _contacts(times: Array, z: Array, reach: int) -> tuple[Array, Array]:
    """Heights z (k,) m of a ball's centre in bounces, and by how much (k,) m each may lie above the true one.

    The straight paths before and after the lowest sample meet in the bounce; that sample itself may be an outlier.
    Where samples are too far apart for such paths, it is the estimate.
    """
    inner, beside = np.arange(reach, len(z) - reach), int(reach > 1)
    last, first = inner - beside, inner + beside
    before, after = times[last] - times[inner - reach], times[inner + reach] - times[first]
    fall = (z[last] - z[inner - reach]) / before - 0.5 * STANDARD_GRAVITY * before
    rise = (z[inner + reach] - z[first]) / after + 0.5 * STANDARD_GRAVITY * after
    third = float(median(np.abs(np.diff(z, 3))))
    noise = MAD_TO_SIGMA * third / np.sqrt(20.0)  # the third difference of white noise has 20 times its variance
    least = LEAST_REVERSAL + SURELY * noise * np.sqrt(2.0) / (reach * float(median(np.diff(times))))
    lowest = z[inner] == sliding_window_view(z, 2 * reach + 1).min(axis=1)
    found = lowest & (fall < -least) & (rise > least)
    fall, rise, span = fall[found], rise[found], (times[first] - times[last])[found]
    if not beside:
        return z[inner][found], 0.5 * rise * (times[inner + 1] - times[inner - 1])[found]
    low, high = z[last][found], z[first][found]
    late = np.clip((high - rise * span - low) / (fall - rise), 0.0, span)
    return low + fall * late, np.zeros(len(low))
