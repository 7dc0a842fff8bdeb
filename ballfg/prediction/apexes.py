"""Finds the apex, the highest point of a flight between bounces, in true, predicted or measured positions."""

from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.state import POSITION, VELOCITY, VZ

HALF_WIDTH: Final = 0.05
"""s to each side of the highest sample over which a parabola is fitted. Drag bends a path off its parabola by less than
0.1 mm there; of 3 mm of noise it leaves 1.5 mm at 120 Hz."""
LEAST_FITTED: Final = 5  # Least number of samples for the fit of a parabola to noisy positions
FLIGHTS: Final = 3  # Number of flights whose apex is searched: before the first bounce, after it, after the second

_NO_POINT: Final = np.full(3, np.nan)


def flight_bounds(times: Array, bounces: Array) -> list[tuple[float, float]]:
    """(start, end) s of the first `FLIGHTS` flights; fewer if the track ends before.

    Args: times: (n,) s.  bounces: (b,) s, in order.
    """
    edges = [float(times[0]), *map(float, bounces[:FLIGHTS]), float(times[-1])]
    return [(edges[i], edges[i + 1]) for i in range(min(len(edges) - 1, FLIGHTS)) if edges[i + 1] > edges[i]]


def true_apexes(times: Array, states: Array, bounces: Array) -> tuple[Array, Array]:
    """Apexes of the true motion, between frames on the cubic through both frames' positions and velocities.

    That cubic strays by h^4 z'''' / 384, less than 1 nm at 120 Hz.

    Args: times: (n,) s.  states: (n, 9), noise-free.  bounces: (b,) s.
    Returns: positions (3, 3) m and times (3,) s, NaN for flights without an apex inside the track.
    """
    points, when = np.full((FLIGHTS, 3), np.nan), np.full(FLIGHTS, np.nan)
    turns = np.flatnonzero((states[:-1, VZ] > 0.0) & (states[1:, VZ] <= 0.0))
    for flight, (start, end) in enumerate(flight_bounds(times, bounces)):
        inside = turns[(times[turns] >= start) & (times[turns + 1] <= end)]
        found = [_cubic_apex(times[i : i + 2], states[i : i + 2]) for i in inside]
        if found:
            points[flight], when[flight] = max(found, key=lambda apex: float(apex[0][2]))
    return points, when


def _cubic_apex(times: Array, states: Array) -> tuple[Array, float]:
    """Position (3,) m and time (s) at which the cubic through two states (2, 9) is highest."""
    h = float(times[1] - times[0])
    (p, q), (u, v) = states[:, POSITION], h * states[:, VELOCITY]
    # p + u s + b s^2 + a s^3 with s from 0 to 1
    b, a = 3 * (q - p) - 2 * u - v, 2 * (p - q) + u + v
    # the root of u + 2 b s + 3 a s^2 in [0, 1], in the form that holds for a = 0 too; b < 0 where gravity rules
    s = u[2] / (-b[2] + np.sqrt(b[2] ** 2 - 3 * a[2] * u[2]))
    return p + s * (u + s * (b + s * a)), float(times[0] + s * h)


def path_apex(times: Array, positions: Array, start: float, end: float) -> tuple[Array, float]:
    """Highest point of a path between two times: the vertex of a parabola round its highest sample.

    Parabolas in time fit all three coordinates, and z gives the time. If the highest sample is the first or last, or
    the path does not bend down round it, the result is that sample: a prediction that never rises still has a highest
    point.

    Args: times: (n,) s.  positions: (n, 3) m.  start, end: s.
    Returns: position (3,) m and time s; NaN if the path has no sample there.
    """
    rows = np.flatnonzero((times >= start) & (times <= end))
    if not len(rows):
        return _NO_POINT.copy(), float("nan")
    top = rows[np.argmax(positions[rows, 2])]
    near = rows[np.abs(times[rows] - times[top]) <= HALF_WIDTH]
    highest = positions[top].copy(), float(times[top])
    if top in (rows[0], rows[-1]) or len(near) < LEAST_FITTED:
        return highest
    since = times[near] - times[top]
    curve = np.polynomial.polynomial.polyfit(since, positions[near], 2)  # (3 powers, 3 axes)
    slope, bend = curve[1, 2], curve[2, 2]
    if not bend < 0.0:
        return highest
    vertex = float(np.clip(-slope / (2 * bend), since[0], since[-1]))
    return np.asarray(vertex ** np.arange(3) @ curve), float(times[top] + vertex)


def measured_apexes(times: Array, positions: Array, bounces: Array) -> tuple[Array, Array]:
    """Apexes of measured positions, if the flight and its samples reach `HALF_WIDTH` to each side.

    Args: times: (n,) s.  positions: (n, 3) m.  bounces: (b,) s.
    Returns: as `true_apexes`.
    """
    points, when = np.full((FLIGHTS, 3), np.nan), np.full(FLIGHTS, np.nan)
    for flight, (start, end) in enumerate(flight_bounds(times, bounces)):
        point, time = path_apex(times, positions, start, end)
        fitted = int((np.abs(times - time) <= HALF_WIDTH).sum())
        if start + HALF_WIDTH <= time <= end - HALF_WIDTH and fitted >= LEAST_FITTED:
            points[flight], when[flight] = point, time
    return points, when
