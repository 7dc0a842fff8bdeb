"""Determines units and the up axis from the fall of the ball, by the known gravity."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from ballfg.arrays import Array
from ballfg.state import STANDARD_GRAVITY

LENGTHS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}  # units of length in m
TIMES: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # units of time in s
Shot: TypeAlias = tuple[Array, Array]  # stamps (n,) and positions (n, 3)
AXES: Final = ("x", "-x", "y", "-y", "z", "-z")  # possible directions of up
_WINDOW: Final = 0.12  # s, fit of an acceleration: 3 mm of noise at 100 Hz leave 2 m/s^2; most flights are longer
_LONGER: Final = (0.2, 0.3)  # s, likewise, where noise hides the fall
_SHOWN: Final = 0.4  # score from which no longer windows are tried
_STEPS: Final = (1e-4, 0.34)  # s between two samples: no camera is faster, and slower ones do not show the fall
_LEAST_SAMPLES: Final = 5
_WIDTH: Final = 0.3  # gravities, standard deviation of an acceleration about its model: noise, spin, bounces
_DRAGS: Final = np.linspace(0.0, 0.2, 11)  # 1/m; a table-tennis ball has 0.13, a tennis ball 0.02
_TABLE_TENNIS: Final = 6  # index of the drag of a table-tennis ball, 0.12 1/m
_MOST_WINDOWS: Final = 4000
_MOST_SPEED: Final = 120.0  # m/s, largest speed; the fastest smash of any ball game is slower
_COINCIDENCE: Final = 0.02  # share of windows that fit by chance; it keeps the ratio of two small scores near one


@dataclass(frozen=True)
class Scale:
    """One reading of the numbers: their units and the axis that points up."""

    length: str
    time: str
    up: str
    score: float  # weighted share of the windows with the acceleration of a falling ball, 0 to 1
    windows: int
    drag: float  # 1/m, the quadratic drag that fits the windows best
    other_ball: float = 1.0  # odds of that drag against the one of a table-tennis ball


def scales(
    shots: Sequence[Shot],
    lengths: Collection[str] = tuple(LENGTHS),
    times: Collection[str] = tuple(TIMES),
    ups: Collection[str] = AXES,
) -> list[Scale]:
    """Every combination of units and up axis, the likeliest first.

    The acceleration of short windows is compared with gravity along the axis and drag against the velocity. The score
    of a combination is the mean of exp(-r^2 / 2), with r the difference in units of 0.3 g.

    Args: shots: times (n,) and positions (n, 3) of each, in their own units.  lengths, times, ups: possible values.
    Returns: the combinations; empty if no window is long enough.
    """
    best: list[Scale] = []
    for window in (_WINDOW, *_LONGER):
        found = _scales(shots, lengths, times, ups, window)
        if found and (not best or found[0].score > best[0].score):
            best = found
        if best and best[0].score >= _SHOWN:
            break
    return best


def _scales(
    shots: Sequence[Shot], lengths: Collection[str], times: Collection[str], ups: Collection[str], window: float
) -> list[Scale]:
    """`scales` by windows of one length, s."""
    found: list[Scale] = []
    for time in times:
        velocities, accelerations = _windows(shots, TIMES[time], window)
        if not len(velocities):
            continue
        for length in lengths:
            v, a = velocities * LENGTHS[length], accelerations * LENGTHS[length]
            speeds = np.linalg.norm(v, axis=1, keepdims=True)
            flying = np.median(speeds) <= _MOST_SPEED
            drag = -speeds * v
            for up in ups:
                gravity = np.zeros(3)
                gravity["xyz".index(up[-1])] = STANDARD_GRAVITY * (1.0 if up[0] == "-" else -1.0)
                misses = [np.sum((a - gravity - k * drag) ** 2, axis=1) for k in _DRAGS]
                fits = [float(np.exp(-0.5 * miss / (_WIDTH * STANDARD_GRAVITY) ** 2).mean()) for miss in misses]
                best = int(np.argmax(fits))
                score, other_ball = fits[best] if flying else 0.0, odds(fits[best], fits[_TABLE_TENNIS])
                found.append(Scale(length, time, up, score, len(v), float(_DRAGS[best]), other_ball))
    return sorted(found, key=lambda scale: -scale.score)


def odds(best: float, other: float) -> float:
    """Ratio of two scores; about 2 is decisive."""
    return (best + _COINCIDENCE) / (other + _COINCIDENCE)


def _windows(shots: Sequence[Shot], unit: float, window: float) -> tuple[Array, Array]:
    """Velocities and accelerations (k, 3) in lengths per s and s^2, of windows that overlap by half."""
    steps = [float(np.median(np.diff(t))) * unit for t, _ in shots if len(t) >= _LEAST_SAMPLES]
    if not steps or not _STEPS[0] <= np.median(steps) <= _STEPS[1]:
        return np.empty((0, 3)), np.empty((0, 3))
    count = max(_LEAST_SAMPLES, round(window / float(np.median(steps))) + 1)
    hop = max(1, count // 2)
    places = [(i, start) for i, (t, _) in enumerate(shots) for start in range(0, len(t) - count + 1, hop)]
    places = places[:: max(1, len(places) // _MOST_WINDOWS)]
    velocities, accelerations = [], []
    for i, start in places:
        t, p = (values[start : start + count] for values in shots[i])
        s = (t - t.mean()) * unit
        if s[-1] - s[0] > 2.5 * count * np.median(steps):  # missing frames may hide a bounce
            continue
        width = max(float(s[-1] - s[0]), 1e-12)
        design = np.stack([np.ones_like(s), s / width, (s / width) ** 2], axis=1)
        _, slope, bend = np.linalg.lstsq(design, p - p.mean(axis=0), rcond=None)[0]
        velocities.append(slope / width)
        accelerations.append(2.0 * bend / width**2)
    return np.array(velocities).reshape(-1, 3), np.array(accelerations).reshape(-1, 3)
