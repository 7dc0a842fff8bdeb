"""Finds the ends of a table from tracks: bounces lie above the table, falls beside it.

The table is assumed to have the size of the rules, with its long side along x or y. The cost of each place of its
centre on a grid is the number of balls that contradict it; exp(-cost) is its probability.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import MAD_TO_SIGMA, Array
from ballfg.dynamics.surfaces import TABLE_LENGTH, TABLE_WIDTH
from ballfg.state import STANDARD_GRAVITY, Z
from ballfg.tracks import TABLE_TENNIS, Track

BASELINE: Final = 0.01  # s, least distance between three samples that give a velocity; 3 mm of noise then give 0.2 m/s
LEAST_BOUNCES: Final = 5  # Least number of bounces that shows at which height the ball meets the table
MISTAKEN: Final = 0.02  # Probability of a false bounce or fall: a hit at the table's height, an outlier
MOST_CONTRADICTING: Final = 0.1
"""Largest share of balls that may contradict the best place; above it the table has another size or direction."""
EDGE_TOLERANCE: Final = 0.03
"""m. A ball this near to an edge may touch or fall: its radius, half a degree between table and frame, 1 % of scale."""
GRID_STEP: Final = 0.01  # m
SURE: Final = 0.9  # A side ends the table if at least one ball fell beyond it with this probability
RADIUS_TOLERANCE: Final = 0.15
"""Largest relative difference from the radius of a table-tennis ball; balls of 38 and 44 mm exist, too."""
_UPWARD_GRAVITY: Final = np.array([0.0, 0.0, STANDARD_GRAVITY])


@dataclass(frozen=True)
class TableExtent:
    """A table's ends, as far as the tracks show them."""

    sides: tuple[float, float, float, float]
    """(x_low, x_high, y_low, y_high) m; infinite if no ball fell beyond the side."""
    sigmas: tuple[float, float, float, float]  # m, of each side; 0 where it is infinite
    bounces: int  # number of bounces on the table
    falls: int  # number of balls that fell past it

    def __str__(self) -> str:
        ends = [
            f"{name} = {side:.2f} +- {sigma:.2f} m"
            for name, side, sigma in zip("xxyy", self.sides, self.sigmas, strict=True)
            if math.isfinite(side)
        ]
        return (
            f"the table ends at {', '.join(ends)}, found from {self.bounces} bounces and {self.falls} balls that fell "
            "past it; frame.table in dataset.yaml states its ends"
        )


def find_table_extent(tracks: Iterable[Track], table_height: float, radius: float) -> TableExtent | None:
    """The ends of a table-tennis table, from balls that bounced on it and balls that fell past it.

    Args: tracks: of balls around one table.  table_height: m, z of its surface.  radius: m, of the ball.
    Returns: the ends; None if no side is known: no ball fell, few bounced at this height, another ball is played with,
        or the balls contradict a table of the rules' size.
    """
    if abs(radius / TABLE_TENNIS.radius - 1.0) > RADIUS_TOLERANCE:
        return None
    paths = [(track.seconds, track.positions) for track in tracks]
    bounces = np.concatenate([np.empty((0, 3)), *(_bounces(*path, table_height + radius, radius) for path in paths)])
    if len(bounces) < LEAST_BOUNCES:
        return None
    contact = float(np.median(bounces[:, Z]))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(bounces[:, Z] - contact)))
    depth = max(radius, 4.0 * scatter)
    falls = np.concatenate([_falls(*path, contact, depth) for path in paths])
    return _fit(bounces, falls) if len(falls) else None


def _bounces(times: Array, positions: Array, contact: float, radius: float) -> Array:
    """(b, 3) m, places of the ball's centre at bounces less than a radius from the height of contact."""
    reach = _reach(times)
    i = np.arange(2 * reach, len(times) - 1 - 2 * reach)
    start, fall, _ = _arcs(times, positions, (i - 2 * reach, i - reach, i), i)
    end, rise, _ = _arcs(times, positions, (i + 1, i + 1 + reach, i + 1 + 2 * reach), i)
    turn = (rise - fall)[:, Z]
    ahead = np.divide((start - end)[:, Z], turn, out=np.full(len(i), -1.0), where=turn > 0.0)
    after = ahead[:, None]  # s until both arcs are at one height; negative if the ball does not turn upwards
    place = start + after * fall - after**2 / 2 * _UPWARD_GRAVITY
    fall, rise = fall - after * _UPWARD_GRAVITY, rise - after * _UPWARD_GRAVITY
    least = math.sqrt(2 * STANDARD_GRAVITY * radius)  # m/s, of a ball that rises by a radius
    pushed = np.linalg.norm((rise - fall)[:, :Z], axis=1)
    found = (after[:, 0] >= 0.0) & (after[:, 0] <= times[i + 1] - times[i]) & (np.abs(place[:, Z] - contact) < radius)
    found &= (fall[:, Z] < -least) & (rise[:, Z] > least) & (rise[:, Z] < least - fall[:, Z])
    found &= pushed < 2 * least - 2 * fall[:, Z]  # a hit pushes more than a friction of 1
    found[1:] &= ~found[:-1]  # the neighbouring interval saw the same bounce
    return place[found]


def _falls(times: Array, positions: Array, contact: float, depth: float) -> Array:
    """(f, 3) m, places at which balls fell past the height of contact.

    A ball `depth` below it did not touch the table. The place is a quarter of that depth below contact, where noise
    does not yet make a rolling ball look like a falling one.
    """
    reach = _reach(times)
    i = np.arange(2 * reach, len(times))
    _, velocity, misfit = _arcs(times, positions, (i - 2 * reach, i - reach, i), i)
    z = positions[:, Z]
    below = z < contact - depth
    stays = below[np.minimum(i + 1, len(z) - 1)]
    falling = below[i] & ~below[i - 1] & stays & (velocity[:, Z] < 0.0) & (misfit < depth / 2)
    level, places = contact - depth / 4, []
    for last in i[falling]:
        above = np.flatnonzero(z[:last] >= level)
        if len(above):
            k = above[-1]
            share = (z[k] - level) / (z[k] - z[k + 1])
            places.append(positions[k] + share * (positions[k + 1] - positions[k]))
    return np.reshape(places, (-1, 3))


def _reach(times: Array) -> int:
    """Number of samples between neighbours of the three that give a velocity."""
    return max(math.ceil(BASELINE / float(np.median(np.diff(times)))), 1)


def _arcs(
    times: Array, positions: Array, samples: tuple[NDArray[np.intp], ...], at: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """Free falls through three samples each at stamps `at`: (m, 3) m, (m, 3) m/s, largest misfit (m,) m along z."""
    rows = np.stack(samples)
    t = (times[rows] - times[at])[..., None]
    straight = positions[rows] + t**2 / 2 * _UPWARD_GRAVITY
    middle, centre = t.mean(axis=0), straight.mean(axis=0)
    velocity = ((t - middle) * (straight - centre)).sum(axis=0) / ((t - middle) ** 2).sum(axis=0)
    place = centre - middle * velocity
    misfit = np.abs(straight - place - t * velocity)[..., Z].max(axis=0)
    return place, velocity, misfit


def _fit(bounces: Array, falls: Array) -> TableExtent | None:
    """The ends of the table that best divides bounces (b, 2+) m from falls (f, 2+) m."""
    sizes = ((TABLE_LENGTH, TABLE_WIDTH), (TABLE_WIDTH, TABLE_LENGTH))
    grids = [[np.arange(-side / 2, side / 2, GRID_STEP) for side in size] for size in sizes]
    centre = np.median(bounces, axis=0)  # the median bounce lies on the table
    middles = [(float(centre[0]) + along, float(centre[1]) + across) for along, across in grids]
    costs = [_contradicting(bounces, falls, *place, size) for place, size in zip(middles, sizes, strict=True)]
    least = min(float(cost.min()) for cost in costs)
    if least > MOST_CONTRADICTING * (len(bounces) + len(falls)):
        return None
    price = math.log(1.0 / MISTAKEN - 1.0)
    weights = [np.exp(-price * (cost - least)) for cost in costs]
    ends = []
    for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
        weight = np.concatenate([w.sum(axis=1 - axis) for w in weights])
        places = np.concatenate([m[axis] + sign * s[axis] / 2 for m, s in zip(middles, sizes, strict=True)])
        ends.append(_side(places, weight / weight.sum(), falls[:, axis], sign))
    sides, sigmas = zip(*ends, strict=True)
    return None if all(map(math.isinf, sides)) else TableExtent(sides, sigmas, len(bounces), len(falls))


def _contradicting(bounces: Array, falls: Array, x: Array, y: Array, size: tuple[float, float]) -> Array:
    """(x, y) number of balls that contradict a table of a size (m) with its centre there; in part near an edge."""

    def inside(places: Array, margin: float) -> list[Array]:
        """For each axis, 1 where a place lies within the table made larger by a margin, less within the tolerance."""
        return [
            np.clip((size[axis] / 2 + margin - np.abs(places[:, axis] - middle[:, None])) / EDGE_TOLERANCE, 0.0, 1.0)
            for axis, middle in enumerate((x, y))
        ]

    (on_x, on_y), (past_x, past_y) = inside(bounces, EDGE_TOLERANCE), inside(falls, 0.0)
    return np.asarray(len(bounces) - on_x @ on_y.T + past_x @ past_y.T)


def _side(places: Array, weight: Array, falls: Array, sign: float) -> tuple[float, float]:
    """A side and its sigma (m), from its probable places; infinite if no ball surely fell beyond it."""
    beyond = (weight * (sign * (falls[:, None] - places) > -EDGE_TOLERANCE)).sum(axis=1)
    if beyond.max() < SURE:
        return sign * math.inf, 0.0
    order = np.argsort(places)
    middle = float(places[order][np.searchsorted(np.cumsum(weight[order]), 0.5)])
    return middle, math.sqrt(float(weight @ (places - middle) ** 2))
